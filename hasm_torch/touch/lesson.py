"""A lesson: a person's fingers and guiding hand, the robot, and what it knows.

fingers ──► HSRTouchEnv ──joints, skin──► whoever leads: guiding hand, replay or model
                 ▲                                        │
                 └──────────────── target ◄───────────────┘

One call of `step` is a control step. Nothing here knows of threads, time or pages. A live robot is
pushed by hand; where it is not driven, whoever leads it starts anew from where it then is.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from hasm_torch.episode import Episode
from hasm_torch.model.felt import calibrate, skin_encoder
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import HSRTouchEnv
from hasm_torch.sim.scene import OBJECT_POSITION
from hasm_torch.sim.teacher import YieldTeacher
from hasm_torch.touch.demonstrations import Recorder, Replay
from hasm_torch.touch.fingers import Fingers
from hasm_torch.touch.ghosts import Ghosts, ways
from hasm_torch.touch.guide import HandGuide
from hasm_torch.touch.history import History, Reason, Why
from hasm_torch.touch.live import Live
from hasm_torch.touch.pointing import Ray, cells_in_world, drag_force, hit_cell, patch_of

Array = NDArray[np.float64]

SHOWN_REASONS = 5


class Lesson:
    """One robot that is taught.

    Attributes:
        env: The simulation, or what stands for a live robot.
        live: The live robot, or None.
        fingers: What the person pushes.
        guide: The person's guiding hand.
        model: What the robot knows; it may be empty.
        known: How many demonstrations that is.
        recorder: The recording that goes on, or waits to be kept; None without one.
        recording: Whether it goes on.
        replay: The demonstration that is played, or None.
        hold_below: Confidence below which the robot holds still, 0 to 1.
        ghosts: Joint positions of the ghosts by name; empty when they are off or nothing touches.
        history: The last seconds.

    Args:
        env: The simulation, or what stands for a live robot.
        model: What the robot knows.
        seed: Of what resets draw.
    """

    def __init__(self, env: HSRTouchEnv, model: HASM, seed: int) -> None:
        self.env = env
        self.fingers = Fingers(tuple(env.skin.patches))
        self.live = env if isinstance(env, Live) else None
        self.guide = HandGuide(env)
        self._yielding = YieldTeacher(env)
        self.recorder: Recorder | None = None
        self.recording = False
        self.replay: Replay | None = None
        self.hold_below = 0.0
        self.ghosts: dict[str, Array] = {}
        self.history = History(len(env.skin.patches), len(JOINTS))
        self._encoder = skin_encoder(
            model.config, model.body, *calibrate(model.config, model.body, [])
        )
        self._shown = False
        self._led = False
        self._patch: str | None = None
        self.learn(model, ways(model))
        self._seen = env.reset(seed=seed)[0]
        self._felt = self._encoder.start()
        if self.live is None:
            self.fingers.press(env.skin.patches[0], None, 1.0)
            self.step()  # what a push takes is compiled before the time counts
            self.fingers.let_go()
        self._begin(env.reset(seed=seed)[0])

    # ---- What a person does.

    def touch(self, ray: Ray, pixels: float) -> None:
        """Put the mouse's finger on the skin that is pointed at, and push.

        Raises:
            ValueError: All fingers are in use.
        """
        cell = hit_cell(ray, cells_in_world(self.env.model, self.env.data, self.env.skin))
        self._patch = None
        if cell is not None:
            self._patch, self._cell = patch_of(self.env.skin, cell)
            self.press(pixels)

    def press(self, pixels: float) -> None:
        """Push harder or softer with the mouse's finger, by the length of the drag."""
        if self._patch is not None:
            self.fingers.press(self._patch, self._cell, drag_force(pixels))

    def lift(self, pin: bool = False) -> None:
        """Lift the mouse's finger, or let its push stay."""
        if pin:
            self.fingers.pin()
        else:
            self.fingers.lift()
        self._patch = None

    def record(self) -> None:
        """Begin a recording, in place of one that was not kept."""
        self.stop()
        self.recorder, self.recording = Recorder(), True

    def stop(self) -> None:
        """End what goes on: a recording, which then waits to be kept, or a replay."""
        self.recording = False
        if self.replay is not None:
            self.replay = None
            self.fingers.let_go()
            self._lead_anew()

    def taken(self, number: int, task: str) -> Episode:
        """What was recorded, which is then gone from here.

        Raises:
            ValueError: Nothing was recorded.
        """
        self.stop()
        episode = (self.recorder or Recorder()).episode(number, task)
        self.recorder = None
        return episode

    def play(self, episode: Episode, moved: bool) -> None:
        """Play a demonstration from its own start: its motion, or its touch.

        Raises:
            ValueError: Its touch is played to a robot that knows nothing.
        """
        if not moved and not self.knows:
            raise ValueError("it knows nothing yet, so a touch would not move it")
        self.stop()
        self.fingers.let_go()
        options: dict[str, object] = {"joints": episode.state[0]}
        if episode.observations is not None:
            options["object"] = _displacement(episode)
        self._begin(self.env.reset(options=options)[0])
        self.replay = Replay(episode, moved)

    def reset(self) -> None:
        """Put everything back, but for a live robot; what was recorded stays."""
        self.stop()
        self.fingers.let_go()
        self._begin(self.env.reset()[0])

    def learn(self, model: HASM, models: Sequence[HASM]) -> None:
        """Go on with another model, which is this lesson's own from now on.

        Args:
            model: What the robot knows now.
            models: The same in each of `ghosts.WAYS`; none if it knows nothing.
        """
        self.model, self._rollout = model, model.new_rollout()
        self.known = len(model.episodes)
        self._ways = models
        self.show_ghosts(self._shown)

    def show_ghosts(self, shown: bool) -> None:
        """Show three ways to remember, or not."""
        self._shown = shown
        self._ghosts = Ghosts(self._ways) if shown and self._ways else None
        self.ghosts = {}

    @property
    def knows(self) -> bool:
        """Whether the robot has learned anything."""
        return self.known > 0

    @property
    def recalled(self) -> bool:
        """Whether the model was asked in the last step."""
        return bool(self._rollout.asked) and not self._led

    # ---- What the robot does.

    def step(self) -> None:
        """One control step."""
        replay, env = self.replay, self.env
        if self.live is not None and not self.live.status().driven:
            self.guide.reset()
            self._lead_anew()
        if replay is not None and replay.finished:
            self.stop()
            replay = None
        env.touch_all(self.fingers.touches if replay is None else replay.touches(env.skin))
        seen = self._seen
        target = self._target(seen, replay)
        if self.recording and self.recorder is not None:
            self.recorder.add(seen, target)
            self.recording = not self.recorder.full
        if replay is not None:
            replay.step += 1
        if self._ghosts is not None:
            self.ghosts = self._ghosts.step(*_tensors(seen))
        self._seen, *_ = env.step(target.astype(np.float32))
        forces = self._seen["tactile"].reshape(1, 1, -1, 3)
        felt, _, self._felt = self._encoder.encode(forces, self._felt)
        force = float(env.skin_forces.sum())
        self.history.add(felt[0, 0].astype(np.float64), env.joint_position, force)

    def why(self) -> Why | None:
        """Why the robot moved in the last step, or None where it recalled nothing."""
        if not self.recalled:
            return None
        found = self.model.explain(self._rollout)
        least = min(found, key=lambda e: e.confidence)
        reasons = [
            Reason(source.episode, source.time, source.weight, source.row, explanation.patch)
            for explanation in found
            for source in explanation.sources[:SHOWN_REASONS]
        ]
        return Why(
            reasons=tuple(sorted(reasons, key=lambda r: -r.weight)[:SHOWN_REASONS]),
            confidence=float(least.confidence),
            spread=float(np.exp(max(e.entropy for e in found))),
            posture_known=all(e.posture_known for e in found),
            touch_known=all(e.touch_known for e in found),
        )

    def _target(self, seen: Mapping[str, NDArray[np.float32]], replay: Replay | None) -> Array:
        """Where the joints are led: by the hand, by what is played, or by the model."""
        state, skin, observation = _tensors(seen)
        led = self.recording or self.guide.active or (replay is not None and replay.moved)
        if led != self._led:
            self._lead_anew()
            self._led = led
        if replay is not None and replay.moved:
            return replay.target
        if self.recording and self.live is not None and not self.guide.active:
            self.guide.start_here()
            return self._yielding.step(state, skin).numpy().astype(np.float64)
        if led or not self.knows:
            self._yielding.reset()
            return self.guide.step(state, skin).numpy().astype(np.float64)
        target = self.model.step(
            state, skin, self._rollout, observation, hold_below=self.hold_below
        )
        return target.numpy().astype(np.float64)

    def _lead_anew(self) -> None:
        """Whoever leads next starts from where the robot is."""
        self.guide.start_here()
        self._yielding.reset()
        self._rollout = self.model.new_rollout()

    def _begin(self, seen: dict[str, NDArray[np.float32]]) -> None:
        self._seen, self._felt = seen, self._encoder.start()
        self._patch, self.ghosts = None, {}
        self.guide.reset()
        self._rollout = self.model.new_rollout()


def _tensors(
    seen: Mapping[str, NDArray[np.float32]],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """State, skin and further observations as the model takes them."""
    state, skin, *more = (torch.from_numpy(values) for values in seen.values())
    return state, skin, more[0] if more else None


def _displacement(episode: Episode) -> Array:
    """(2,) where the object stood at the start of an episode, from its usual place, m."""
    assert episode.observations is not None
    x, y, yaw = episode.state[0, -3:].astype(np.float64)
    ahead, aside = episode.observations[0, :2].astype(np.float64)
    place = (
        x + np.cos(yaw) * ahead - np.sin(yaw) * aside,
        y + np.sin(yaw) * ahead + np.cos(yaw) * aside,
    )
    return np.array(place) - OBJECT_POSITION
