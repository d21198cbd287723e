"""The touched HSR with the human who touches it: an episode is one experiment's rollout.

    reset ──► start posture, object, human ──► human.touches(time, state) ──► HSRTouchEnv.step ─┐
                                                          ▲                                     │
                                                          └────────────── until finished ───────┘

An observation already feels what the human did in the control tick before it.
"""

import math
import warnings
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from hasm_torch.evaluation import compliance, grasp, yielding
from hasm_torch.evaluation.along_force import ALONG, motion
from hasm_torch.evaluation.rollout import Array, Human, Trace, row_of
from hasm_torch.lerobot.env_hsr_touch import GRASP, TORSO, check_task
from hasm_torch.robot import JOINTS
from hasm_torch.sim import tasks
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.render import HEIGHT, WIDTH
from hasm_torch.sim.tasks import START_POSES

Observation = dict[str, NDArray[np.float32]]

PICTURE_EVERY = 5  # steps, because a picture takes longer than many steps
LONGEST_PUSH = max(
    compliance.END_AT, yielding.TOUCH_AT + yielding.PUSH_SECONDS + yielding.REST
)  # s
DESCRIPTIONS = {**tasks.TASKS, TORSO: tasks.YIELD_TORSO}
BEHAVIOURS = {behaviour.name: behaviour for behaviour in tasks.BEHAVIOURS}


class HumanTouchEnv(gym.Env[Observation, NDArray[np.float32]]):
    """``HSRTouchEnv`` with a scripted human; an episode ends when the human has finished.

    ``info["is_success"]`` is False until then. "grasp" succeeds if the object is lifted and held,
    "yield" and "torso" if the touched point moved with the force, within 45 degrees; the other
    tasks if the touched joint went the right way and every other joint stayed.

    Args:
        task: "arm_down", "arm_up", "wrist_left", "wrist_right", "yield", "torso" or "grasp".
        force: Force of the touch, N; None draws it anew for every episode.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: If the task or the render mode is unknown.
    """

    metadata = HSRTouchEnv.metadata

    def __init__(
        self, task: str, force: float | None = None, render_mode: str | None = "rgb_array"
    ) -> None:
        check_task(task)
        self.task, self.task_description, self.force = task, DESCRIPTIONS[task], force
        self.sim = HSRTouchEnv(GRASP if task == GRASP else "compliance", render_mode)
        self.render_mode = render_mode
        self.observation_space, self.action_space = (
            self.sim.observation_space,
            self.sim.action_space,
        )
        seconds = grasp.TIME_LIMIT if task == GRASP else LONGEST_PUSH
        self._max_episode_steps = math.ceil(seconds * CONTROL_RATE) + 1
        self._human: Human
        self._rows: list[tuple[Any, ...]] = []
        self._picture: NDArray[np.uint8] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a new human.

        Args:
            seed: Seed of start posture, object place, force and the human's pauses.
            options: Ignored; LeRobot passes a mark of its own.
        """
        super().reset(seed=seed)
        rng = np.random.default_rng(self.np_random.integers(2**31))
        start = self._begin(rng)
        observation, info = self.sim.reset(seed=int(rng.integers(2**31)), options={"joints": start})
        self._time, self._rows, self._picture = float(info["time"]), [], None
        self._touch()
        return observation, self._info(info, finished=False)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """One control tick; the reward is 1 at a successful end."""
        observation, _, _, _, info = self.sim.step(action)
        self._time = float(info["time"])
        self._rows.append(row_of(self.sim, np.asarray(action, dtype=np.float64), info))
        finished = self._human.finished(self._time, self.sim.joint_position)
        info = self._info(info, finished)
        if not finished:
            self._touch()
        return observation, float(info["is_success"]), finished, False, info

    def render(self) -> Any:
        """Image of the scene, drawn anew every ``PICTURE_EVERY`` steps; black without OpenGL."""
        if self._picture is None or len(self._rows) % PICTURE_EVERY == 0:
            try:
                self._picture = self.sim.render()
            except RuntimeError as error:
                warnings.warn(f"the video stays black: {error}", stacklevel=2)
                self._picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        return self._picture

    def close(self) -> None:
        """Free the renderer."""
        self.sim.close()

    def _begin(self, rng: np.random.Generator) -> Array:
        """Draw the human, and where the robot starts."""
        limits = self.sim.joint_lower, self.sim.joint_upper
        drawn = grasp.FORCES if self.task == GRASP else tasks.TEST_FORCES
        force = float(rng.uniform(*drawn)) if self.force is None else self.force
        if self.task == GRASP:
            self._human = grasp.Guide(force, grasp.PAUSES, rng)
            home = np.array(START_POSES[GRASP])
            return tasks.noisy_start(home, tasks.START_NOISE, *limits, rng)
        if self.task in BEHAVIOURS:
            behaviour = BEHAVIOURS[self.task]
            self._human = compliance.even_push(behaviour, force)
            return compliance.start_posture(behaviour, *limits, rng)
        plan = yielding.torso_cases if self.task == TORSO else yielding.cases
        (case,) = plan(1, int(rng.integers(2**31)), [force])
        self._human = case.push
        return yielding.start_posture(case, *limits)

    def _touch(self) -> None:
        self.sim.touch_all(self._human.touches(self._time, self.sim.joint_position))
        self.sim.block(self._human.holds(self._time))

    def _info(self, info: dict[str, Any], finished: bool) -> dict[str, Any]:
        """What LeRobot reads; names and numbers that vector environments can stack."""
        return {
            "is_success": finished and self._succeeded(info),
            "finger_force": float(info["finger_force"]),
            "object_height": float(info["object_height"]),
            "time": self._time,
        }

    def _succeeded(self, info: dict[str, Any]) -> bool:
        if self.task == GRASP:
            return bool(info["is_success"])
        trace = Trace.of(self._rows, False)
        if self.task not in BEHAVIOURS:
            return motion(trace).cos > ALONG
        limits = self.sim.joint_lower, self.sim.joint_upper, self.sim.joint_speed_limit
        behaviour = BEHAVIOURS[self.task]
        return compliance.succeeded(compliance.measure(trace, behaviour, JOINTS, *limits))
