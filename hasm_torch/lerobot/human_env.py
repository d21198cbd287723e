"""The touched HSR with the human who touches it: an episode is one experiment's rollout.

    reset ──► start posture, object, human ──► human.touch(time, state) ──► HSRTouchEnv.step ─┐
                                                          ▲                                   │
                                                          └───────────── until finished ──────┘

An observation already feels what the human did in the control tick before it.
"""

import math
import warnings
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from hasm_torch.evaluation import compliance, grasp
from hasm_torch.evaluation.rollout import Human
from hasm_torch.lerobot.env_hsr_touch import GRASP, TASKS, check_task
from hasm_torch.robot import JOINTS
from hasm_torch.sim.demonstrator import TASKS as DESCRIPTIONS
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.poses import START_POSES
from hasm_torch.sim.render import HEIGHT, WIDTH

Observation = dict[str, NDArray[np.float32]]

COMPLIANCE_FORCES, GRASP_FORCES = (2.0, 14.0), (3.0, 12.0)  # N, from which a touch is drawn
PAUSES = 3  # of the human in a grasp
START_NOISE = 0.05  # rad, of a grasp's start
PICTURE_EVERY = 5  # steps, because a picture takes longer than many steps


class HumanTouchEnv(gym.Env[Observation, NDArray[np.float32]]):
    """``HSRTouchEnv`` with a scripted human; an episode ends when the human has finished.

    ``info["is_success"]`` is False until then. "grasp" succeeds if the object is lifted and held;
    the other tasks if the touched joint went the right way and every other joint stayed.

    Args:
        task: "arm_down", "arm_up", "wrist_left", "wrist_right" or "grasp".
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
        seconds = grasp.TIME_LIMIT if task == GRASP else compliance.END_AT
        self._max_episode_steps = math.ceil(seconds * CONTROL_RATE) + 1
        self._human: Human
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
        place = {}
        if self.task == GRASP:
            self._human = grasp.Guide(self._draw(GRASP_FORCES, rng), PAUSES, rng)
            home = np.array(START_POSES[GRASP])
            limits = self.sim.joint_lower, self.sim.joint_upper
            start = grasp.noisy_start(home, START_NOISE, *limits, rng)
        else:
            index = TASKS.index(self.task)
            force = self._draw(COMPLIANCE_FORCES, rng)
            self._human = compliance.Push(compliance.BEHAVIOURS[index].patch, force)
            case = compliance.ComplianceCase(index, int(rng.integers(2**31)), force, False)
            start = compliance.start_posture(
                case, JOINTS, self.sim.joint_lower, self.sim.joint_upper
            )
            place["object"] = (0.0, 0.0)
        observation, info = self.sim.reset(
            seed=int(rng.integers(2**31)), options={"joints": start, **place}
        )
        self._lowest = self._highest = self._start = self.sim.joint_position
        self._time, self._steps, self._picture = float(info["time"]), 0, None
        self._touch()
        return observation, self._info(info, finished=False)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """One control tick; the reward is 1 at a successful end."""
        observation, _, _, _, info = self.sim.step(action)
        position = self.sim.joint_position
        self._lowest = np.minimum(self._lowest, position)
        self._highest = np.maximum(self._highest, position)
        self._time, self._steps = float(info["time"]), self._steps + 1
        finished = self._human.finished(self._time, position)
        info = self._info(info, finished)
        if not finished:
            self._touch()
        return observation, float(info["is_success"]), finished, False, info

    def render(self) -> Any:
        """Image of the scene, drawn anew every ``PICTURE_EVERY`` steps; black without OpenGL."""
        if self._picture is None or self._steps % PICTURE_EVERY == 0:
            try:
                self._picture = self.sim.render()
            except RuntimeError as error:
                warnings.warn(f"the video stays black: {error}", stacklevel=2)
                self._picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        return self._picture

    def close(self) -> None:
        """Free the renderer."""
        self.sim.close()

    def _touch(self) -> None:
        self.sim.touch(*self._human.touch(self._time, self.sim.joint_position))

    def _draw(self, forces: tuple[float, float], rng: np.random.Generator) -> float:
        return float(rng.uniform(*forces)) if self.force is None else self.force

    def _info(self, info: dict[str, Any], finished: bool) -> dict[str, Any]:
        """What LeRobot reads; names and numbers that vector environments can stack."""
        held = bool(info["is_success"]) if self.task == GRASP else self._yielded()
        return {
            "is_success": finished and held,
            "finger_force": float(info["finger_force"]),
            "object_height": float(info["object_height"]),
            "time": self._time,
        }

    def _yielded(self) -> bool:
        """Whether the touched joint went the right way and the others stayed."""
        behaviour = compliance.BEHAVIOURS[TASKS.index(self.task)]
        joint = JOINTS.index(behaviour.joint)
        moved = behaviour.direction * (self.sim.joint_position - self._start)[joint]
        others = np.delete(self._highest - self._lowest, joint)
        return compliance.succeeded({"displacement": moved, "others": others.max()})
