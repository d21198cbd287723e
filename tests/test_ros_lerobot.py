"""``lerobot-rollout`` drives the simulated HSR, which is in a process of its own."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("rclpy", reason="needs rclpy: install the extra hasm-torch[ros]")
pytest.importorskip("rmw_fastrtps_cpp", reason="needs ros-rmw-fastrtps-cpp: the extra ros")
pytest.importorskip("lerobot", reason="needs lerobot: install the extra hasm-torch[lerobot]")

from ros_robot import PREFIX, Outsider, alone, simulated

from hasm_torch.robot import JOINTS
from hasm_torch.ros.link import HSRLink, LinkConfig
from hasm_torch.ros.live_env import LiveEnv

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
# One process for all commands: their imports take longer than they do.
COMMANDS = f"""
import sys
from pathlib import Path

def run(main, *arguments):
    sys.argv = [main.__module__, *arguments]
    main()

folder = Path(sys.argv[1])
from hasm_torch.apps.training import main as train
from lerobot.scripts.lerobot_rollout import main as rollout
run(train, "--dataset.root=datasets/hsr_yield", f"--output_dir={{folder / 'checkpoint'}}")
for dry_run in "true", "false":
    run(rollout, f"--policy.path={{folder / 'checkpoint'}}", "--robot.type=hsr",
        "--robot.prefix={PREFIX}", f"--robot.dry_run={{dry_run}}", "--fps=50", "--duration=2",
        "--return_to_initial_position=false")
    (folder / f"{{dry_run}} is done").touch()
"""


def test_a_dry_run_moves_nothing_and_the_policy_gives_way_to_a_push(monkeypatch, tmp_path):
    alone(monkeypatch)
    outsider = Outsider()
    with simulated(), open(tmp_path / "printed", "w+") as printed:
        driver = subprocess.Popen(
            [sys.executable, "-c", COMMANDS, str(tmp_path)],
            cwd=ROOT, stdout=printed, stderr=subprocess.STDOUT,
        )  # fmt: skip
        env = LiveEnv(HSRLink(LinkConfig(PREFIX)), 30.0)  # it looks on: a dry run sends nothing
        try:
            before, touches, dry = env.joint_position, [], []
            while driver.poll() is None:
                outsider.push(6.0)
                env.step(before)
                if not (tmp_path / "true is done").exists():
                    dry.append(env.joint_position)
                touches += env.touch_points()[:1]
        finally:
            driver.kill()
            env.close()
            outsider.close()
        printed.seek(0)
        said = printed.read()
    assert driver.returncode == 0, said
    assert "dry run, would send" in said
    np.testing.assert_allclose(dry, [before] * len(dry), atol=2e-3)
    path = touches[-1].point - touches[0].point
    along = path @ touches[0].force / np.linalg.norm(touches[0].force)
    assert np.linalg.norm(path) > 0.03
    assert along > 0.7 * np.linalg.norm(path)


def test_lerobot_finds_the_robot_and_the_policy_takes_its_state_apart():
    import lerobot_robot_hsr
    from lerobot.robots import RobotConfig, make_robot_from_config

    from hasm_torch.lerobot.processor_hasm import SplitState

    robot = make_robot_from_config(RobotConfig.get_choice_class("hsr")(object=True))
    assert isinstance(robot, lerobot_robot_hsr.HSR)
    assert robot.config.dry_run
    names = list(robot.observation_features)
    assert [name.removesuffix(".pos") for name in names[:11]] == list(JOINTS)
    assert len(names) == 11 + 162 + 3
    assert all(name.endswith((".pos", ".vel")) for name in names)  # others lerobot-rollout drops
    sizes = {
        "observation.state": 11,
        "observation.tactile": 162,
        "observation.environment_state": 3,
    }
    whole = torch.arange(176.0)[None]
    parts = SplitState(sizes).observation({"observation.state": whole})
    assert [parts[name].shape[1] for name in sizes] == [11, 162, 3]
    torch.testing.assert_close(torch.cat([parts[name] for name in sizes], dim=1), whole)
