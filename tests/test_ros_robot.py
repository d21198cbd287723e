"""The HSR over ROS 2: the project's own simulation in a second process, loopback only."""

import time

import numpy as np
import pytest
import torch

pytest.importorskip("rclpy", reason="needs rclpy: install the extra hasm-torch[ros]")
pytest.importorskip("rmw_fastrtps_cpp", reason="needs ros-rmw-fastrtps-cpp: the extra ros")

from geometry_msgs.msg import Twist
from ros_robot import PREFIX, Outsider, alone, simulated, until
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray
from trajectory_msgs.msg import JointTrajectory

from hasm_torch.config import HASMConfig
from hasm_torch.evaluation import grasp, yielding
from hasm_torch.evaluation.rollout import run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.evaluation.teaching import learn, near_places, wrist_and_torso
from hasm_torch.robot import JOINTS, Skin
from hasm_torch.ros import topics
from hasm_torch.ros.experiment import roll_out_across
from hasm_torch.ros.link import HSRLink, LinkConfig
from hasm_torch.ros.safety import Mode
from hasm_torch.ros.spinning import Spinning
from hasm_torch.sim.tasks import START_POSES

pytestmark = pytest.mark.slow

FLEX, BASE_X = JOINTS.index("arm_flex_joint"), JOINTS.index("odom_x")
HOME = np.array(START_POSES["compliance"])
PERIOD = 0.02  # s


@pytest.fixture(scope="module", autouse=True)
def domain():
    with pytest.MonkeyPatch.context() as monkeypatch:
        alone(monkeypatch)
        yield


@pytest.fixture(scope="module", autouse=True)
def robot(domain):
    """It takes seconds to begin: other tests run meanwhile."""
    with simulated() as process:
        yield process


@pytest.fixture
def linked():
    made = []

    def link(prefix=PREFIX, **options):
        made.append(HSRLink(LinkConfig(prefix=prefix, **options)))
        return made[-1]

    yield link
    for each in made:
        each.close()


class Still:
    """A robot that stands where it is: joints and skin are told one by one, commands written down.

    Attributes:
        arm: Positions that the arm was sent to.
        twists: Speeds that the base was sent, ahead.
    """

    def __init__(self):
        self.spinning = Spinning("still")
        self.arm, self.twists = [], []
        node, skin = self.spinning.node, Skin.load()
        offer = node.create_publisher
        self._joints = offer(JointState, "/still/joint_states", topics.COMMAND)
        self._skin = offer(Float32MultiArray, "/still/skin", topics.COMMAND)
        self._forces = np.zeros((skin.cells, 3), np.float32)
        name = "/still/arm_trajectory_controller/command"
        self.spinning.listen(JointTrajectory, name, self._take_arm, topics.COMMAND)
        name = "/still/command_velocity"
        self.spinning.listen(Twist, name, self._take_twist, topics.COMMAND)
        self.spinning.start()

    def _take_arm(self, message):
        self.arm.append(list(message.points[0].positions))

    def _take_twist(self, message):
        self.twists.append(message.linear.x)

    def tell(self, skin=True):
        self._joints.publish(topics.joint_state(HOME, np.zeros(len(JOINTS)), 0.0))
        if skin:
            self._skin.publish(topics.skin_message(self._forces))
        time.sleep(PERIOD)


@pytest.fixture
def still(domain):
    made = Still()
    yield made
    made.spinning.close()


@pytest.mark.parametrize("lost", ["skin", "caller"])
def test_skin_alone_going_stale_and_the_callers_silence_hold_then_stop(linked, still, lost):
    link, target = linked("/still", dry_run=False), HOME.copy()
    target[FLEX] += 1.0
    target[BASE_X] += 1.0

    def drive(skin=True):
        still.tell(skin)
        link.command(target)

    assert until(lambda: link.mode is Mode.DRIVING and len(still.arm) > 5, 5.0, drive)
    assert until(lambda: still.twists[-1] > 0.05, 1.0, drive)
    go_on = (lambda: drive(skin=False)) if lost == "skin" else still.tell
    assert until(lambda: link.mode is Mode.HOLDING, 1.0, go_on)
    go_on()
    held, twisted = len(still.arm), len(still.twists)
    assert until(lambda: link.mode is Mode.STOPPED, 1.0, go_on)
    assert len(still.arm) > held + 10
    assert all(position == still.arm[held] for position in still.arm[held:])
    assert not any(still.twists[twisted:])
    assert ("wrist_upper" if lost == "skin" else "nobody") in link.why
    assert not set(JOINTS) & set(link.why.split())
    time.sleep(PERIOD)
    stopped = len(still.arm)
    for _ in range(10):
        go_on()
    assert len(still.arm) == stopped
    assert until(lambda: link.mode is Mode.DRIVING and len(still.arm) > stopped, 1.0, drive)


def test_experiments_across_ros_succeed_as_in_one_process():
    torch.set_num_threads(1)
    planned = {"yield": yielding.cases(4, 3), "grasp": grasp.cases(1, 0, pauses=0)}
    taught = {"yield": wrist_and_torso(40), "grasp": near_places}
    models = {e: learn(f"datasets/hsr_{e}", HASMConfig(), taught[e]) for e in planned}
    rolled = roll_out_across(planned, models, waits=True)
    for experiment, cases in planned.items():
        env = make_env(experiment)
        for case, across in zip(cases, rolled[experiment], strict=True):
            mine = run_case(case, env, models[experiment])[1]
            assert across.figures["violations"] == 0
            assert np.isfinite(across.latencies).mean() > 0.9
            if experiment == "grasp":
                assert across.figures["success"] == mine["success"]
                continue
            motion = across.figures["motion"]
            assert (motion.cos > 0.7) == (mine["motion"].cos > 0.7)
            assert motion.travel == pytest.approx(mine["motion"].travel, abs=0.02)


def test_a_dry_run_has_no_publisher_and_moves_nothing(robot, linked):
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


def test_a_push_by_topic_is_felt_and_commands_move_the_robot_until_an_emergency(robot, linked):
    link, outsider = linked(dry_run=False), Outsider()
    try:
        target = link.wait(20.0).state
        start = target.copy()
        target[FLEX] -= 0.25

        def push():
            outsider.push(6.0)
            link.command(target)

        felt = lambda: link.observe(0.05).skin[:7].sum() > 1.0  # noqa: E731
        assert until(felt, 10.0, push)
        assert until(lambda: link.observe(0.05).state[FLEX] < start[FLEX] - 0.2, 10.0, push)
        outsider.press()
        assert until(lambda: link.mode is Mode.EMERGENCY, 5.0, lambda: time.sleep(0.01))
        assert np.isnan(link.command(start)).all()
        link.release()
        link.wait(5.0)
        assert np.isfinite(link.command(start)).all()
    finally:
        outsider.push(0.0)
        outsider.close()


def test_lost_sensors_are_named_and_stop_the_robot(robot, linked):
    link = linked(dry_run=False)
    link.wait(20.0)
    link.command(link.observe(0.05).state)
    robot.terminate()
    robot.wait(20)

    def drive():
        time.sleep(PERIOD)
        link.command(link.observe(0.0).state)

    assert until(lambda: link.mode is Mode.STOPPED, 5.0, drive)
    with pytest.raises(TimeoutError, match="joint"):
        link.wait(0.2)
