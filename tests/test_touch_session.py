"""A session as pages use it, without a page: commands in, snapshots out, files on disk."""

import time

import numpy as np
import pytest

from hasm_torch.apps.touch import TouchConfig, open_session
from hasm_torch.config import HASMConfig
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import LARGEST_FORCE
from hasm_torch.sim.tasks import START_POSES
from hasm_torch.touch.ghosts import WAYS
from hasm_torch.touch.session import POSTURE, Session
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.simulated import body_in

HAND = "wrist_roll_link"


def session_in(folder, scene="compliance"):
    model = HASM(HASMConfig(drive="spike"), body_in(scene))
    return Session(scene, model, Shelf(folder), seed=0)


@pytest.fixture
def session(tmp_path):
    made = session_in(tmp_path)
    yield made
    made.close()


def steps(session, count):
    for _ in range(count):
        session.step()


def said_next(session, command, *arguments):
    """What is said to a command, however long it takes."""
    session.step()
    number = session.snapshot.said[2]
    session.send(command, *arguments)
    while session.snapshot.said[2] == number:
        session.step()
        time.sleep(0.001)
    return session.snapshot.said[0]


def hand(session):
    return session.lesson.env.data.body(HAND).xpos.copy()


def show(session, patch="wrist_upper", way=(0.0, 0.0, -0.12), name="down", flex=-1.0):
    """Push a patch and lead the hand away, as one demonstration that is kept."""
    session.send("reset")
    session.send("slide", "arm_flex_joint", flex)
    steps(session, 60)
    session.send("pin", patch, 6.0)
    session.send("record")
    steps(session, 10)
    session.send("grab", HAND, hand(session))
    session.send("drag", hand(session) + np.array(way))
    steps(session, 60)
    session.send("drop")
    session.send("let_go")
    return said_next(session, "keep", name)


def pushed(session, patch, force=6.0, count=40):
    """How the hand moves under a push, m."""
    session.send("reset")
    steps(session, 5)
    before = hand(session)
    session.send("pin", patch, force)
    steps(session, count)
    session.send("let_go")
    return hand(session) - before


def test_an_empty_robot_stands_learns_answers_and_forgets(session):
    assert np.abs(pushed(session, "wrist_upper")).max() < 0.003
    assert "Learned demonstration 0" in show(session)
    steps(session, 2)
    assert (session.snapshot.known, session.snapshot.playable) == (1, (0,))
    assert pushed(session, "wrist_upper")[2] < -0.03
    assert "Forgot demonstration 0" in said_next(session, "forget")
    assert np.abs(pushed(session, "wrist_upper")).max() < 0.003
    assert "nothing that could be forgotten" in said_next(session, "forget")


def test_it_says_why_it_moves_and_shows_that_posture(session):
    show(session)
    pushed(session, "wrist_upper")
    why = session.snapshot.why
    assert why.reasons[0].episode == 0
    assert why.reasons[0].patch == "wrist_upper"
    assert 0.0 < sum(reason.weight for reason in why.reasons) <= 1.0 + 1e-6
    session.send("look", 0)
    steps(session, 2)
    expected = session.lesson.model.posture(why.reasons[0].row)
    expected[-3:] = session.snapshot.state[-3:]  # shown where the base is now
    np.testing.assert_allclose(session.snapshot.ghosts[POSTURE], expected)
    session.send("look", None)
    session.send("look", 99)
    steps(session, 2)
    assert POSTURE not in session.snapshot.ghosts


def test_three_ghosts_answer_the_same_touch(session):
    show(session)
    show(session, way=(0.0, 0.0, 0.1), name="elsewhere it leads up", flex=-0.5)
    session.send("ghosts", True)
    session.send("reset")
    session.send("pin", "wrist_upper", 6.0)
    steps(session, 40)
    ghosts = session.snapshot.ghosts
    assert set(WAYS) <= set(ghosts)
    robot = session.snapshot.state
    lift = JOINTS.index("arm_lift_joint")
    best, mean, own = (ghosts[w][lift] - START_POSES["compliance"][lift] for w in WAYS)
    assert best < -0.04  # the demonstration from here leads down
    assert mean > best + 0.02  # the other one, which leads up, counts as much
    assert own == pytest.approx(robot[lift] - START_POSES["compliance"][lift], abs=0.03)
    session.send("let_go")
    steps(session, 60)
    assert not session.snapshot.ghosts


def test_a_demonstration_is_played_as_motion_and_as_touch(session):
    show(session)
    episode = session._shown[0]
    session.send("play", None, True)
    steps(session, len(episode))
    assert session.snapshot.mode == "play"
    np.testing.assert_allclose(session.snapshot.state, episode.state[-1], atol=0.02)
    steps(session, 4)
    assert session.snapshot.mode == "live"
    session.send("play", 0, False)
    steps(session, 2)
    start = hand(session)
    steps(session, 30)
    assert session.snapshot.arrows[0].patch == "wrist_upper"
    steps(session, 30)
    assert hand(session)[2] < start[2] - 0.03


def test_two_pushes_at_once_and_no_third(session):
    session.send("pin", "wrist_upper", 5.0)
    session.send("pin", "torso_front", 99.0)
    steps(session, 20)
    arrows = {arrow.patch: arrow for arrow in session.snapshot.arrows}
    assert arrows["wrist_upper"].newtons == 5.0
    assert arrows["torso_front"].newtons == LARGEST_FORCE
    assert all(arrow.pinned for arrow in arrows.values())
    assert session.snapshot.cells.sum() == pytest.approx(20.0, abs=0.5)
    assert "fingers are in use" in said_next(session, "pin", "hand", 5.0)


def test_a_drag_on_a_cell_pushes_there(session):
    env = session.lesson.env
    cell = env.skin.slices["wrist_upper"].start + 3
    body = env.data.body(HAND)
    point = body.xpos + body.xmat.reshape(3, 3) @ env.skin.positions[cell].numpy()
    eye = point + np.array([0.2, -0.3, 0.8])
    session.send("touch", eye, point - eye, 10.0)
    session.send("press", 70.0)
    steps(session, 20)
    arrow = session.snapshot.arrows[0]
    assert (arrow.patch, arrow.newtons, arrow.pinned) == ("wrist_upper", 7.0, False)
    np.testing.assert_allclose(arrow.point, point, atol=0.005)
    np.testing.assert_allclose(arrow.inward, [0.0, 0.0, -1.0], atol=0.05)
    assert session.snapshot.cells.argmax() == cell
    session.send("lift", False)
    steps(session, 2)
    assert not session.snapshot.arrows


NONSENSE = (
    ("fly", ()),
    ("touch", ("a", "b", "c")),
    ("touch", ([0, 0, 0], [0, 0, 0], 5.0)),
    ("press", (None,)),
    ("pin", ("nose", 5.0)),
    ("pin", ("hand", "strong")),
    ("grab", ("no_body", [0, 0, 0])),
    ("grab", (HAND, [1e9, 0, 0])),
    ("drag", ("there",)),
    ("slide", ("arm_flex_joint", float("nan"))),
    ("slide", (JOINTS, 1.0)),
    ("sure", ("very",)),
    ("look", ("up",)),
    ("play", (7, True)),
    ("keep", ("nothing was recorded",)),
    ("save", ("dataset", "../../etc")),
    ("save", ("everything", "x")),
    ("load", ("checkpoint", "none_there")),
    ("record", (1, 2, 3)),
)


def test_nonsense_harms_nothing(session):
    steps(session, 5)
    before = session.snapshot.state
    for command, arguments in NONSENSE:
        session.send(command, *arguments)
        steps(session, 3)
    session.send("ghosts", True)  # of a robot that knows nothing
    steps(session, 5)
    assert session.snapshot.said[1]
    np.testing.assert_allclose(session.snapshot.state, before, atol=0.002)
    assert "Learned" in show(session)


def test_when_the_driver_leaves_nothing_is_held_and_the_recording_waits(session):
    session.send("pin", "wrist_upper", 6.0)
    session.send("record")
    session.send("grab", HAND, hand(session))
    session.send("drag", hand(session) + np.array([0.0, 0.0, -0.1]))
    steps(session, 20)
    session.send("left")
    steps(session, 10)
    there = session.snapshot.state
    steps(session, 20)
    assert not session.snapshot.arrows
    assert session.snapshot.unkept
    np.testing.assert_allclose(session.snapshot.state, there, atol=0.005)
    assert "Learned" in said_next(session, "keep", "")


def test_it_holds_still_while_it_is_less_sure(session):
    show(session)
    session.send("sure", 1.1)  # is taken as certain
    session.send("slide", "wrist_flex_joint", 0.5)  # not a posture that was shown
    steps(session, 150)
    before = hand(session)
    session.send("pin", "wrist_upper", 6.0)
    steps(session, 30)
    assert np.abs(hand(session) - before).max() < 0.005


def test_saved_things_are_loaded_again(session, tmp_path):
    show(session, name="nod")
    moved = pushed(session, "wrist_upper")
    assert "Saved what it knows" in said_next(session, "save", "checkpoint", "one")
    assert Shelf(tmp_path).things() == [("checkpoint", "one")]
    said_next(session, "forget")
    assert "nothing was shown yet" in said_next(session, "save", "dataset", "one")
    assert "Loaded" in said_next(session, "load", "checkpoint", "one")
    steps(session, 2)
    assert (session.snapshot.known, session.snapshot.playable) == (1, ())
    np.testing.assert_allclose(pushed(session, "wrist_upper"), moved, atol=0.01)


def test_a_grasp_is_shown_where_the_object_stands(tmp_path):
    session = session_in(tmp_path, "grasp")
    session.send("reset")
    steps(session, 2)
    assert "Learned" in show(session)
    episode = session._shown[0]
    assert episode.observations.shape == (len(episode), 3)
    session.send("reset")  # the object stands elsewhere
    steps(session, 2)
    place = session.lesson.env.object_position
    session.send("play", 0, True)
    steps(session, 2)
    seen = session.lesson._seen["environment_state"]
    assert np.abs(session.lesson.env.object_position - place).max() > 1e-4
    np.testing.assert_allclose(seen, episode.observations[0], atol=2e-3)
    said = said_next(session, "save", "checkpoint", "grasp")
    session.close()
    other = session_in(tmp_path)
    assert "Saved" in said
    assert "use the other --scene" in said_next(other, "load", "checkpoint", "grasp")
    other.close()


def test_the_command_opens_what_was_asked_for(tmp_path, monkeypatch, capsys):
    session = open_session(TouchConfig(teach="empty", output_dir=tmp_path))
    show(session)
    said_next(session, "save", "checkpoint", "mine")
    session.close()
    checkpoint = tmp_path / "checkpoints" / "mine"
    again = open_session(TouchConfig(checkpoint=checkpoint, output_dir=tmp_path))
    steps(again, 2)
    assert again.snapshot.known == 1
    again.close()
    with pytest.raises(ValueError, match="other --scene"):
        open_session(TouchConfig(checkpoint=checkpoint, scene="grasp"))
    with pytest.raises(FileNotFoundError):
        open_session(TouchConfig(checkpoint=tmp_path / "nowhere"))
    for wrong in ({"scene": "moon"}, {"port": 70000}):
        with pytest.raises(ValueError, match="must be"):
            TouchConfig(**wrong)
