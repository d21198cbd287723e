"""A lesson on a live HSR, which is the project's own simulation in a second process."""

import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: install the extra hasm-torch[ros]")
pytest.importorskip("rmw_fastrtps_cpp", reason="needs ros-rmw-fastrtps-cpp: the extra ros")
pytest.importorskip("viser", reason="needs viser: install the extra hasm-torch[touch]")

from ros_robot import PREFIX, Outsider, alone, simulated, until

from hasm_torch.apps.touch import HSRConfig, TouchConfig, open_session
from hasm_torch.robot import JOINTS
from hasm_torch.ros.live_env import LiveEnv

pytestmark = pytest.mark.slow

FLEX = JOINTS.index("arm_flex_joint")


@pytest.fixture
def live(monkeypatch, tmp_path):
    """Opens a session with the robot, and someone who pushes it."""
    alone(monkeypatch)
    outsider, sessions = Outsider(), []

    def opened(dry_run):
        hsr = HSRConfig(PREFIX, dry_run, connect_timeout=30.0)
        sessions.append(open_session(TouchConfig("hsr", hsr, teach="empty", output_dir=tmp_path)))
        return sessions[-1], outsider

    with simulated():
        yield opened
        for session in sessions:
            session.close()
        outsider.close()


def steps(session, seconds):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        session.step()


def pushed(session, outsider, seconds, force=6.0):
    """How the touched point moves while it is pushed, along the push, m."""
    env = session.lesson.env
    assert until(env.touch_points, 5.0, lambda: (outsider.push(force), session.step()))
    first = env.touch_points()[0]
    steps(session, seconds)
    last = env.touch_points()[0]
    outsider.push(0.0)
    assert until(lambda: not env.touch_points(), 5.0, session.step)
    return float((last.point - first.point) @ first.force / np.linalg.norm(first.force))


def said_next(session, command, *arguments):
    steps(session, 0.1)
    number = session.snapshot.said[2]
    session.send(command, *arguments)
    assert until(lambda: session.snapshot.said[2] != number, 20.0, session.step)
    return session.snapshot.said[0]


def test_it_yields_while_it_is_taught_answers_by_itself_and_stops_in_an_emergency(live):
    session, outsider = live(dry_run=False)
    assert isinstance(session.lesson.env, LiveEnv)
    assert abs(pushed(session, outsider, 0.5)) < 0.005  # it knows nothing
    session.send("record")
    assert pushed(session, outsider, 1.0) > 0.03
    assert "Learned demonstration 0" in said_next(session, "keep", "yield")
    session.step()
    assert session.snapshot.known == 1
    assert pushed(session, outsider, 1.0) > 0.03

    before = session.snapshot.state
    session.send("reset")
    steps(session, 0.5)
    np.testing.assert_allclose(session.snapshot.state, before, atol=0.01)

    session.send("slide", "arm_flex_joint", -2.0)
    steps(session, 0.3)
    session.send("emergency")
    steps(session, 0.5)  # what moves brakes
    stopped = session.snapshot
    assert stopped.live.emergency
    assert stopped.state[FLEX] > -1.9
    steps(session, 0.5)
    np.testing.assert_allclose(session.snapshot.state, stopped.state, atol=2e-3)
    session.send("release")
    steps(session, 0.5)  # and does not go on to where it was sent before
    assert not session.snapshot.live.emergency
    np.testing.assert_allclose(session.snapshot.state, stopped.state, atol=0.01)
    session.send("slide", "arm_flex_joint", float(stopped.state[FLEX]) + 0.2)
    assert until(
        lambda: session.snapshot.state[FLEX] > stopped.state[FLEX] + 0.15, 5.0, session.step
    )


def test_a_dry_run_moves_nothing_and_what_makes_no_sense_is_refused(live):
    session, _ = live(dry_run=True)
    assert session.snapshot.live.dry_run
    assert session.snapshot.live.told.startswith("Dry run")
    before = session.snapshot.state
    session.send("slide", "arm_flex_joint", -2.0)
    steps(session, 0.5)
    np.testing.assert_allclose(session.snapshot.state, before, atol=1e-3)
    assert "pushed by hand" in said_next(session, "pin", "wrist_upper", 5.0)
    assert "played" in said_next(session, "play", None, True)
    with pytest.raises(ValueError, match="not put anywhere"):
        session.lesson.env.reset(options={"joints": before})
    with pytest.raises(ValueError, match="pushed by hand"):
        session.lesson.env.touch_all({"wrist_upper": 5.0})
