"""The HSR over ROS 2: the project's own simulation in a second process, loopback only."""

import os
import random
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

pytest.importorskip("rclpy", reason="needs rclpy: install the extra hasm-torch[ros]")
pytest.importorskip("rmw_fastrtps_cpp", reason="needs ros-rmw-fastrtps-cpp: the extra ros")

from std_msgs.msg import Empty, Float32MultiArray

from hasm_torch.config import HASMConfig
from hasm_torch.evaluation import grasp, yielding
from hasm_torch.evaluation.rollout import run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.evaluation.teaching import learn, near_places, wrist_and_torso
from hasm_torch.robot import JOINTS
from hasm_torch.ros import topics
from hasm_torch.ros.experiment import roll_out_across
from hasm_torch.ros.link import HSRLink, LinkConfig
from hasm_torch.ros.safety import Mode
from hasm_torch.ros.spinning import Spinning

FLEX = JOINTS.index("arm_flex_joint")


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 101)))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@pytest.fixture
def simulated(alone):
    command = [sys.executable, "-m", "hasm_torch.apps.simulated_hsr", "--prefix=/robot"]
    process = subprocess.Popen(command, env=dict(os.environ), stdout=subprocess.DEVNULL)
    yield process
    process.terminate()
    process.wait(20)


@pytest.fixture
def linked():
    made = []

    def link(**options):
        made.append(HSRLink(LinkConfig(prefix="/robot", **options)))
        return made[-1]

    yield link
    for each in made:
        each.close()


@pytest.mark.parametrize(
    ("experiment", "planned", "choice"),
    [
        ("yield", yielding.cases(4, 3), wrist_and_torso(40)),
        ("grasp", grasp.cases(1, 0, pauses=0), near_places),
    ],
)
def test_an_experiment_across_ros_succeeds_as_in_one_process(experiment, planned, choice):
    torch.set_num_threads(1)
    model = learn(f"datasets/hsr_{experiment}", HASMConfig(), choice)
    env = make_env(experiment)
    here = [run_case(case, env, model)[1] for case in planned]
    rolled = roll_out_across(experiment, planned, model, waits=True)
    for mine, across in zip(here, rolled, strict=True):
        assert across.figures["violations"] == 0
        assert np.isfinite(across.latencies).mean() > 0.9
        if experiment == "grasp":
            assert across.figures["success"] == mine["success"]
        else:
            assert (across.figures["motion"].cos > 0.7) == (mine["motion"].cos > 0.7)
            assert across.figures["motion"].travel == pytest.approx(mine["motion"].travel, abs=0.02)


def test_a_dry_run_has_no_publisher_and_moves_nothing(simulated, linked):
    link = linked()
    before = link.wait(20.0).state
    for _ in range(50):
        reading = link.observe(0.05)
        sent = link.command(reading.state + 0.5)
    assert np.isfinite(sent).all()
    names = [name for name, _ in link._spinning.node.get_publisher_names_and_types_by_node(
        "hasm_hsr", "/")]  # fmt: skip
    assert not [name for name in names if "command" in name]
    np.testing.assert_allclose(link.observe(0.05).state, before, atol=1e-3)


def test_a_push_by_topic_is_felt_and_commands_move_the_robot_until_an_emergency(simulated, linked):
    link = linked(dry_run=False)
    other = Spinning("other")
    name = topics.topic("/robot", "push")
    push = other.node.create_publisher(Float32MultiArray, name, topics.COMMAND)
    name = topics.topic("/robot", "hasm", "emergency_stop")
    button = other.node.create_publisher(Empty, name, topics.COMMAND)
    other.start()
    try:
        start = link.wait(20.0).state
        deadline, felt, sent = time.monotonic() + 10, 0.0, start
        push.publish(Float32MultiArray(data=[0.0, 6.0, 2.0]))
        while time.monotonic() < deadline and (felt < 1.0 or sent[FLEX] > start[FLEX] - 0.2):
            reading = link.observe(0.05)
            felt = max(felt, float(reading.skin[:7].sum()))
            target = start.copy()
            target[FLEX] -= 0.25
            sent = link.command(target)
            push.publish(Float32MultiArray(data=[0.0, 6.0, 2.0]))
        assert felt > 1.0
        assert link.observe(0.05).state[FLEX] < start[FLEX] - 0.05
        button.publish(Empty())
        while time.monotonic() < deadline and link.mode is not Mode.EMERGENCY:
            time.sleep(0.01)
        assert link.mode is Mode.EMERGENCY
        assert np.isnan(link.command(start)).all()
        link.release()
        link.wait(5.0)
        assert np.isfinite(link.command(start)).all()
    finally:
        other.close()


def test_lost_sensors_are_named_and_stop_the_robot(simulated, linked):
    link = linked(dry_run=False)
    link.wait(20.0)
    link.command(link.observe(0.05).state)
    simulated.terminate()
    simulated.wait(20)
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline and link.mode is not Mode.STOPPED:
        time.sleep(0.02)
        link.command(link.observe(0.0).state)
    assert link.mode is Mode.STOPPED
    with pytest.raises(TimeoutError, match="joint"):
        link.wait(0.2)


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
