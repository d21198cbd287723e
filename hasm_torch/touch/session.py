"""The control loop of a lesson, in a thread of its own at 50 Hz.

    pages ──commands──► queue ──► Lesson ──► Snapshot ──► pages
                                    ▲  │
    Learner ──outcomes──► queue ────┘  └── demonstrations to be learned ──► Learner

Pages only put commands in a queue and look at snapshots: whatever they send, the loop goes on.
"""

import copy
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.episode import Episode
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.tasks import BASE_JOINTS
from hasm_torch.touch.history import Arrow, Snapshot, Why
from hasm_torch.touch.learner import Learner, Outcome
from hasm_torch.touch.lesson import Lesson
from hasm_torch.touch.live import REFUSED
from hasm_torch.touch.pace import Pace, come_first
from hasm_torch.touch.pointing import Ray
from hasm_torch.touch.shelf import Shelf

Array = NDArray[np.float64]

SHOWN_EVERY = 2  # control steps: pages see 25 snapshots a second
EXPLAINED_EVERY = 5  # control steps at least
POSTURE = "posture then"  # the ghost that shows where an association was made


class Session:
    """A lesson that runs, for any number of pages.

    Attributes:
        scene: "compliance" or "grasp".
        shelf: Where things are saved.
        learner: Learns, saves and loads beside the control loop.

    Args:
        scene: "compliance" or "grasp".
        model: What the robot knows at the start; it may be empty.
        shelf: Where things are saved.
        seed: Of what resets draw.
        env: What stands for a live robot, in place of a simulation; it is closed with the session.
    """

    def __init__(
        self,
        scene: str,
        model: HASM,
        shelf: Shelf,
        seed: int = 0,
        env: HSRTouchEnv | None = None,
    ) -> None:
        self.scene, self.shelf = scene, shelf
        self.lesson = Lesson(env or HSRTouchEnv(scene), copy.deepcopy(model), seed)
        self.pace = Pace()
        self._inbox: queue.SimpleQueue[tuple[str, tuple[Any, ...]]] = queue.SimpleQueue()
        self.learner = Learner(scene, model, shelf, lambda outcome: self.send("outcome", outcome))
        self._shown: dict[int, Episode] = {}
        self._said = ("", False, 0)
        self._why: Why | None = None
        self._posture: Array | None = None
        self._steps = self._explained = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)
        lesson = self.lesson
        self._commands: dict[str, Callable[..., None]] = {
            "touch": lambda eye, way, pixels: lesson.touch(_ray(eye, way), float(pixels)),
            "press": lambda pixels: lesson.press(float(pixels)),
            "lift": lambda pin: lesson.lift(bool(pin)),
            "pin": lambda patch, force: lesson.fingers.press(patch, None, float(force), True),
            "let_go": lesson.fingers.let_go,
            "grab": lambda body, point: lesson.guide.grab(body, _vector(point)),
            "drag": lambda point: lesson.guide.drag(_vector(point)),
            "drop": lesson.guide.let_go,
            "slide": lambda joint, position: lesson.guide.slide(joint, float(position)),
            "base": lambda goes: setattr(lesson.guide, "base", bool(goes)),
            "record": self._record,
            "stop": lesson.stop,
            "keep": self._keep,
            "forget": self.learner.forget,
            "play": self._play,
            "reset": lesson.reset,
            "ghosts": lambda shown: lesson.show_ghosts(bool(shown)),
            "sure": self._hold_below,
            "look": self._look,
            "save": lambda kind, name: self.learner.save(kind, name),
            "load": lambda kind, name: self.learner.load(kind, name),
            "emergency": self._no_robot,
            "release": self._no_robot if lesson.live is None else lesson.live.release,
            "left": self._left,
            "outcome": self._outcome,
        }
        self._snapshot = self._look_around()

    @property
    def snapshot(self) -> Snapshot:
        """The newest moment of the lesson."""
        return self._snapshot

    def start(self) -> None:
        """Begin the control loop."""
        self._thread.start()

    def close(self) -> None:
        """End the control loop and what is done beside it."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        self.learner.close()
        self.lesson.env.close()

    def send(self, command: str, *arguments: Any) -> None:
        """Put a command in the queue; one that makes no sense is answered in the snapshot.

        An emergency stop of a live robot waits for nothing.
        """
        if command == "emergency" and self.lesson.live is not None:
            self.lesson.live.emergency_stop()
            return
        self._inbox.put((command, arguments))

    def load_bundled(self, datasets: Path) -> None:
        """Learn the bundled teaching of the scene, beside the control loop."""
        self.learner.load_bundled(datasets)

    def step(self) -> None:
        """One control step: what was sent, then the robot."""
        while not self._inbox.empty():
            self._obey(*self._inbox.get())
        self.lesson.step()
        self._steps += 1
        if self.lesson.recalled and self._steps >= self._explained + EXPLAINED_EVERY:
            self._why, self._explained = self.lesson.why(), self._steps
        if self._steps % SHOWN_EVERY == 0:
            self._snapshot = self._look_around()

    def _run(self) -> None:
        come_first()
        if self.lesson.live is not None:  # its samples give the time
            while not self._ending.is_set():
                self.step()
        while not self._ending.is_set():
            self.pace.begin()
            self.step()
            self.pace.end()

    def _obey(self, command: str, arguments: tuple[Any, ...]) -> None:
        try:
            if command not in self._commands:
                raise ValueError(f"there is no {command!r} to be done")
            if self.lesson.live is not None and command in REFUSED:
                raise ValueError(REFUSED[command])
            self._commands[command](*arguments)
        # Whatever a page sends, the loop goes on.
        except Exception as error:
            self._say(str(error), failed=True)

    def _say(self, text: str, failed: bool = False) -> None:
        self._said = (text, failed, self._said[2] + 1)

    # ---- Commands that need more than the lesson.

    def _record(self) -> None:
        self.lesson.record()
        led = "push a patch, then drag the gripper or use the joint sliders"
        if self.lesson.live is not None:
            led = "push the robot's skin, and it yields; the page leads it too"
        self._say(f"Recording: {led}. Keep it when you are done.")

    def _no_robot(self) -> None:
        raise ValueError("the robot is simulated: there is nothing to be stopped")

    def _keep(self, task: str) -> None:
        episode = self.lesson.taken(len(self._shown), str(task).strip() or "shown by hand")
        self.learner.keep(episode, episode.task)

    def _play(self, number: int | None, moved: bool) -> None:
        if not self._shown:
            raise ValueError("nothing to play yet: record and keep a demonstration first")
        if number is not None and number not in self._shown:
            raise ValueError(f"there is no demonstration {number!r} to play")
        number = max(self._shown) if number is None else number
        self.lesson.play(self._shown[number], bool(moved))
        what = "how you moved it" if moved else "your touch, and the robot answers by itself"
        self._say(f"Playing demonstration {number}: {what}.")

    def _hold_below(self, confidence: float) -> None:
        self.lesson.hold_below = float(np.clip(float(confidence), 0.0, 1.0))

    def _look(self, rank: int | None) -> None:
        """Show the posture of the reason at a place of the list, or none."""
        self._posture = None
        if rank is not None and self._why is not None and 0 <= rank < len(self._why.reasons):
            row = self._why.reasons[rank].row
            self._posture = np.asarray(self.lesson.model.posture(row), dtype=np.float64)

    def _left(self) -> None:
        """Nobody drives any more: no finger stays, nothing goes on; what was recorded waits."""
        self.lesson.stop()
        self.lesson.fingers.let_go()
        self.lesson.guide.reset()

    def _outcome(self, outcome: Outcome) -> None:
        if outcome.model is not None:
            self.lesson.learn(outcome.model, outcome.ways)
            self._shown = outcome.shown or {}
            self._why = self._posture = None
        self._say(outcome.said, outcome.failed)

    # ---- What pages see.

    def _look_around(self) -> Snapshot:
        lesson, env = self.lesson, self.lesson.env
        mode = "record" if lesson.recording else "play" if lesson.replay else "live"
        ghosts = dict(lesson.ghosts)
        if self._posture is not None:  # where the base was then is of no interest
            base = np.isin(JOINTS, BASE_JOINTS)
            ghosts[POSTURE] = np.where(base, env.joint_position, self._posture)
        busy = self.learner.busy
        return Snapshot(
            mode=mode,
            recorded=0.0 if lesson.recorder is None else lesson.recorder.seconds,
            unkept=lesson.recorder is not None and not lesson.recording,
            qpos=env.data.qpos.copy(),
            state=env.joint_position,
            slid=frozenset(lesson.guide.slid),
            cells=env.skin_forces.sum(axis=1),
            arrows=self._arrows(),
            ghosts=ghosts,
            why=self._why,
            history=lesson.history.last(),
            known=lesson.known,
            playable=tuple(self._shown),
            said=self._said,
            busy=None if busy is None else (busy[0], time.monotonic() - busy[1]),
            step_ms=self.pace.milliseconds,
            behind=self.pace.behind,
            live=None if lesson.live is None else lesson.live.status(),
        )

    def _arrows(self) -> tuple[Arrow, ...]:
        env, pinned = self.lesson.env, {p.patch: p for p in self.lesson.fingers.pushes}
        arrows = []
        for touch in env.touch_points():
            body = env.data.body(env.skin.link[touch.patch])
            cell = env.skin.slices[touch.patch].start + (touch.cell or 0)
            inward = -body.xmat.reshape(3, 3) @ env.skin.normals[cell].numpy()
            push = pinned.get(touch.patch)
            newtons = push.force if push else float(np.linalg.norm(touch.force))
            stays = push is not None and push.pinned
            arrows.append(Arrow(touch.patch, touch.point.copy(), inward, newtons, stays))
        return tuple(arrows)


def _vector(point: Any) -> Array:
    vector = np.asarray(point, dtype=np.float64)
    if vector.shape != (3,):
        raise ValueError(f"expected a point (3,), got shape {vector.shape}")
    return vector


def _ray(eye: Any, way: Any) -> Ray:
    return Ray(_vector(eye), _vector(way))
