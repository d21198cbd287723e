"""Teaching by touch: the recorded episodes of both experiments.

The demonstrator's robot yields by an analytic rule: while a patch is touched, the taught motion
advances at a speed proportional to the force that the skin feels. What the episodes hold is the
joints, the skin and the joint targets; the rule itself is not in them.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hasm_torch.data.episodes import Episode
from hasm_torch.evaluation.compliance import BEHAVIOURS, Behaviour
from hasm_torch.evaluation.grasp import GRASP_PATCH, REACH_PATCH, noisy_start
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.poses import GRASP_POSES, START_POSES

Array = NDArray[np.float64]

# Speed of a taught motion, joint ranges a second for each newton: 10 N turn the wrist by
# 0.7 rad/s, half its limit; in a grasp 10 N lift the arm by 0.14 m/s.
COMPLIANCE_SPEED, GRASP_SPEED = 0.0125, 0.02
COMPLIANCE_FORCES = (3.0, 6.0, 10.0)  # N
GRASP_FORCES = (4.0, 7.0, 10.0)  # N
TASKS = {
    "arm_down": "push the arm down at the upper side of the wrist",
    "arm_up": "push the arm up at the under side of the wrist",
    "wrist_left": "turn the wrist at its left side",
    "wrist_right": "turn the wrist at its right side",
    "grasp": "reach by the upper side of the wrist, grasp and retract by its right side",
}
REACH_PATH = np.array([GRASP_POSES[pose] for pose in ("before", "around")])
GRASP_PATH = np.array([GRASP_POSES[pose] for pose in ("closed", "lifted")])
# Other joints' postures during the one-joint episodes, shares of their ranges.
POSTURE = (0.3, 0.5, 0.5, 0.5, 0.5, 0.6, 0.6, 0.5)


class _Recorder:
    """Steps the environment under one episode's touches and keeps what it saw."""

    def __init__(self, env: HSRTouchEnv, start: Array, offset: tuple[float, float]) -> None:
        self.env, self.target = env, start.copy()
        options = {"joints": start, "object": offset}
        self.observation, _ = env.reset(seed=0, options=options)
        self.rows: list[tuple[NDArray[np.float32], NDArray[np.float32], Array]] = []

    def step(self, patch: str | None, force: float) -> float:
        """One control step towards the target; returns the force felt by the patch, N."""
        self.env.touch(patch, force)
        state, tactile = self.observation["state"], self.observation["tactile"]
        self.rows.append((state, tactile, self.target.copy()))
        self.observation, *_ = self.env.step(self.target.astype(np.float32))
        felt = self.env.skin_forces
        return float(felt[self.env.skin.slices[patch]].sum()) if patch else 0.0

    def rest(self, seconds: float) -> None:
        """Leave the robot alone."""
        for _ in range(round(seconds * CONTROL_RATE)):
            self.step(None, 0.0)

    def episode(self, index: int, task: str) -> Episode:
        """Everything seen so far."""
        state, tactile, action = (np.array(column, np.float32) for column in zip(*self.rows))
        return Episode(
            index=index,
            task=task,
            time=np.arange(len(state)) / CONTROL_RATE,
            state=state,
            action=action,
            tactile=tactile.reshape(len(state), -1, 3),
        )


def compliance_episodes(forces: tuple[float, ...] = COMPLIANCE_FORCES) -> Iterator[Episode]:
    """Record each one-joint behaviour over the whole range of its joint, once a force.

    Args:
        forces: Forces of the touches, N.

    Yields:
        Episodes, one for each behaviour and force.
    """
    env = HSRTouchEnv("compliance")
    index = 0
    for behaviour in BEHAVIOURS:
        for force in forces:
            yield _compliance_episode(env, behaviour, force, index)
            index += 1
    env.close()


def _compliance_episode(
    env: HSRTouchEnv, behaviour: Behaviour, force: float, index: int
) -> Episode:
    joint = JOINTS.index(behaviour.joint)
    lower, upper = env.joint_lower, env.joint_upper
    start = lower + np.array(POSTURE) * (upper - lower)
    begin, end = (lower, upper) if behaviour.direction > 0 else (upper, lower)
    start[joint] = begin[joint]
    recorder = _Recorder(env, start, (0.0, 0.0))
    recorder.rest(0.2)
    while recorder.target[joint] != end[joint]:
        felt = recorder.step(behaviour.patch, force)
        travel = COMPLIANCE_SPEED * felt / CONTROL_RATE * (end - begin)[joint]
        moved = recorder.target[joint] + travel
        recorder.target[joint] = np.clip(moved, lower[joint], upper[joint])
    for _ in range(round(0.3 * CONTROL_RATE)):
        recorder.step(behaviour.patch, force)
    recorder.rest(0.2)
    return recorder.episode(index, TASKS[behaviour.name])


def grasp_episodes(count: int, seed: int, start_noise: float = 0.05) -> Iterator[Episode]:
    """Record grasps: touch on one patch reaches, touch on another grasps and retracts.

    Args:
        count: Number of episodes.
        seed: Seed of forces, pauses, start states and object places.
        start_noise: Standard deviation of the start state, rad (m: a fifth of it).

    Yields:
        Episodes.
    """
    env = HSRTouchEnv("grasp")
    rng = np.random.default_rng(seed)
    for index in range(count):
        home = np.array(START_POSES["grasp"])
        start = noisy_start(home, start_noise, env.joint_lower, env.joint_upper, rng)
        offset = tuple(rng.uniform(-0.01, 0.01, 2))
        recorder = _Recorder(env, start, offset)
        force = GRASP_FORCES[index % len(GRASP_FORCES)]
        recorder.rest(0.3)
        _follow(recorder, REACH_PATCH, force, np.vstack([start, REACH_PATH]), rng)
        recorder.rest(0.5)
        _follow(recorder, GRASP_PATCH, force, np.vstack([REACH_PATH[-1:], GRASP_PATH]), rng)
        recorder.rest(0.5)
        yield recorder.episode(index, TASKS["grasp"])
    env.close()


def _follow(
    recorder: _Recorder, patch: str, force: float, path: Array, rng: np.random.Generator
) -> None:
    """Lead the robot along a path at a speed proportional to the felt force, with one pause."""
    span = recorder.env.joint_upper - recorder.env.joint_lower
    lengths = (np.abs(np.diff(path, axis=0)) / span).max(axis=1)
    mileage = np.concatenate([[0.0], np.cumsum(lengths)])
    pause_at = rng.uniform(0.2, 0.8) * mileage[-1]
    travelled = 0.0
    while travelled < mileage[-1]:
        felt = recorder.step(patch, force)
        travelled = min(travelled + GRASP_SPEED * felt / CONTROL_RATE, mileage[-1])
        recorder.target = np.array([np.interp(travelled, mileage, column) for column in path.T])
        if travelled > pause_at:
            recorder.rest(0.4)
            pause_at = np.inf
    for _ in range(round(0.3 * CONTROL_RATE)):
        recorder.step(patch, force)
