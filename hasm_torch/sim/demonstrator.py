"""Teaching by touch: the recorded episodes of all experiments.

    human ──touch──► HSRTouchEnv ──joints, skin──► Teacher ──target──► HSRTouchEnv
                                        └────────────┴──────► Episode

What the episodes hold is joints, skin and joint targets; the teacher's law is not in them. All
teaching is done with one force, `TEACHING_FORCE`.
"""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import from_numpy

from hasm_torch.episode import Episode
from hasm_torch.robot import JOINTS
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.tasks import (
    BASE_JOINTS,
    BASE_PLACE,
    BEHAVIOURS,
    COMPLIANCE_EPISODES,
    GRASP,
    GRASP_PATCH,
    GRASP_PAUSE,
    OBJECT_PLACES,
    PUSH_GAP,
    PUSH_SECONDS,
    PUSH_TILT,
    REACH_PATCH,
    START_NOISE,
    START_POSES,
    TEACHING_FORCE,
    TORSO_PATCHES,
    TREMOR,
    TREMOR_RATE,
    WRIST_PATCHES,
    YIELD_TORSO,
    YIELD_WRIST,
    Behaviour,
    noisy_start,
    random_posture,
    upright_posture,
)
from hasm_torch.sim.teacher import ComplianceTeacher, GraspTeacher, Teacher, YieldTeacher

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

LEAD_SPEED = 0.8  # share of the joints' speed limits at which a hand leads an untouched robot
FLEX = JOINTS.index("arm_flex_joint")


class Recorder:
    """Steps the environment under one episode's touches and keeps what it saw.

    Args:
        teacher: Answers the touches.
        start: (J,) start positions of the joints, rad or m.
        place: Displacement of the object in x and y, m.
    """

    def __init__(self, teacher: Teacher, start: Array, place: Sequence[float] = (0.0, 0.0)) -> None:
        self.teacher, self.env = teacher, teacher.env
        self.observation, _ = self.env.reset(seed=0, options={"joints": start, "object": place})
        teacher.reset()
        self.rows: list[tuple[Array32, ...]] = []

    def step(self, patch: str | None, force: float = 0.0, cell: int | None = None) -> None:
        """One control step."""
        self.env.touch(patch, force, cell)
        state, skin, *bound = self.observation.values()
        target = self.teacher.step(from_numpy(state), from_numpy(skin)).numpy()
        self.rows.append((state, target, skin, *bound))
        self.observation, *_ = self.env.step(target)

    def steps(self, seconds: float, patch: str | None = None, force: float = 0.0) -> None:
        """An even touch of a patch's middle, or rest."""
        for _ in range(round(seconds * CONTROL_RATE)):
            self.step(patch, force)

    def lead(self, positions: Array) -> None:
        """Lead the untouched robot to other positions (J,), rad or m, at `LEAD_SPEED`."""
        way = positions - self.env.joint_position
        speed = LEAD_SPEED * self.env.joint_speed_limit
        count = int(np.ceil((np.abs(way) / speed).max() * CONTROL_RATE))
        for part in np.linspace(0.0, 1.0, count + 1)[1:]:
            self.teacher.target = positions - (1.0 - part) * way
            self.step(None)

    def episode(self, index: int, task: str) -> Episode:
        """Everything seen so far."""
        return episode_of(self.rows, index, task)


def episode_of(rows: Sequence[tuple[Array32, ...]], index: int, task: str) -> Episode:
    """An episode of the control steps that a demonstration took.

    Args:
        rows: State (J,), target (J,), skin (cells * 3,) and, where more is bound, that (N,), of
            each step.
        index: Number of the episode.
        task: What is done, in words.
    """
    state, action, skin, *bound = (np.array(column) for column in zip(*rows))
    return Episode(
        index=index,
        task=task,
        time=np.arange(len(state)) / CONTROL_RATE,
        state=state,
        action=action,
        tactile=skin.reshape(len(state), -1, 3),
        observations=bound[0] if bound else None,
    )


def yield_episodes(count: int, torso: bool, generator: np.random.Generator) -> Iterator[Episode]:
    """Record pushes to which the robot yields: every patch in turn, in one random posture.

    The finger trembles and pushes a random cell. The point is led a little beside the force, by a
    random angle that stays the same during a push.

    Args:
        count: Number of episodes.
        torso: Push the torso, whose pushes lead the base, instead of the wrist.
        generator: Draws postures, cells, order, tilt and tremor.

    Yields:
        Episodes.
    """
    env = HSRTouchEnv("compliance")
    teacher = YieldTeacher(env)
    patches = TORSO_PATCHES if torso else WRIST_PATCHES
    base = [JOINTS.index(joint) for joint in BASE_JOINTS]
    for index in range(count):
        start = random_posture(env.joint_lower, env.joint_upper, generator)
        start[base] = generator.uniform(-1.0, 1.0, 3) * (BASE_PLACE, BASE_PLACE, np.pi)
        task = YIELD_TORSO if torso else YIELD_WRIST
        yield pushed_in_turn(teacher, start, patches, generator, index, task)
    env.close()


def pushed_in_turn(
    teacher: YieldTeacher,
    start: Array,
    patches: Sequence[str],
    generator: np.random.Generator,
    index: int,
    task: str,
) -> Episode:
    """Record one episode in which patches are pushed, each once, in random order.

    Args:
        teacher: Answers the pushes; of any robot.
        start: (J,) where the robot starts, rad or m.
        patches: Patches to push.
        generator: Draws order, cells, tilt and tremor.
        index: Number of the episode.
        task: What is done, in words.
    """
    recorder = Recorder(teacher, start)
    recorder.steps(0.1)
    for patch in generator.permutation(patches).tolist():
        push(recorder, teacher, patch, generator)
        recorder.steps(PUSH_GAP)
    return recorder.episode(index, task)


def push(
    recorder: Recorder, teacher: YieldTeacher, patch: str, generator: np.random.Generator
) -> None:
    """Record one trembling push of a random cell, led beside the force.

    Args:
        recorder: Of the episode.
        teacher: Its teacher.
        patch: Patch to push.
        generator: Draws cell, tilt and tremor.
    """
    env = teacher.env
    cells = env.skin.slices[patch]
    cell = int(generator.integers(cells.stop - cells.start))
    normal = env.data.body(env.skin.link[patch]).xmat.reshape(3, 3) @ (
        env.skin.normals[cells][cell].numpy()
    )
    axis = np.cross(normal, generator.standard_normal(3))
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(
        quaternion, axis / np.linalg.norm(axis), PUSH_TILT * generator.standard_normal()
    )
    mujoco.mju_quat2Mat(matrix, quaternion)
    teacher.tilt = matrix.reshape(3, 3)
    rate, phase = generator.uniform(*TREMOR_RATE), generator.uniform(0.0, 2.0 * np.pi)
    for time in np.arange(round(PUSH_SECONDS * CONTROL_RATE)) / CONTROL_RATE:
        tremor = TREMOR * float(np.sin(2.0 * np.pi * rate * time + phase))
        recorder.step(patch, TEACHING_FORCE * (1.0 + tremor), cell)


def compliance_episodes(
    generator: np.random.Generator, repeats: int = COMPLIANCE_EPISODES
) -> Iterator[Episode]:
    """Record each one-joint behaviour over the whole range of its joint.

    Args:
        generator: Draws the postures of the other joints.
        repeats: Episodes of each behaviour.

    Yields:
        Episodes, behaviour by behaviour.
    """
    env = HSRTouchEnv("compliance")
    teacher = ComplianceTeacher(env)
    for number, behaviour in enumerate(BEHAVIOURS):
        for index in range(repeats):
            start = upright_posture(env.joint_lower, env.joint_upper, generator)
            # The arm's flexion, where it is not what yields: each episode in its part of the range.
            part = (index + generator.uniform()) / repeats
            start[FLEX] = (1.0 - part) * env.joint_lower[FLEX] + part * env.joint_upper[FLEX]
            yield _compliance_episode(teacher, behaviour, start, number * repeats + index)
    env.close()


def _compliance_episode(
    teacher: ComplianceTeacher, behaviour: Behaviour, start: Array, index: int
) -> Episode:
    joint = JOINTS.index(behaviour.joint)
    ends = teacher.env.joint_lower[joint], teacher.env.joint_upper[joint]
    begin, end = ends if behaviour.direction > 0 else ends[::-1]
    for straight in ("arm_roll_joint", "wrist_roll_joint"):  # so that the arm moves with the force
        start[JOINTS.index(straight)] = 0.0
    start[joint] = begin
    recorder = Recorder(teacher, start)
    recorder.steps(0.2)
    while teacher.target is not None and teacher.target[joint] != end:
        recorder.step(behaviour.patch, TEACHING_FORCE)
    recorder.steps(0.3, behaviour.patch, TEACHING_FORCE)
    recorder.steps(0.2)
    return recorder.episode(index, behaviour.task)


def grasp_episodes(
    generator: np.random.Generator, places: Sequence[tuple[float, float]] = OBJECT_PLACES
) -> Iterator[Episode]:
    """Record grasps: touch on one patch reaches, touch on another grasps and retracts.

    Args:
        generator: Draws start states and pauses.
        places: Displacement of the object in x and y for each episode, m.

    Yields:
        Episodes, with the object's place among the observations.
    """
    env = HSRTouchEnv("grasp")
    teacher = GraspTeacher(env)
    home = np.array(START_POSES["grasp"])
    for index, place in enumerate(places):
        start = noisy_start(home, START_NOISE, env.joint_lower, env.joint_upper, generator)
        recorder = Recorder(teacher, start, place)
        recorder.steps(0.3)
        for patch in (REACH_PATCH, GRASP_PATCH):
            pause_at = generator.uniform(0.2, 0.8)
            while teacher.progress(patch) < 1.0:
                recorder.step(patch, TEACHING_FORCE)
                if teacher.progress(patch) > pause_at:
                    recorder.steps(GRASP_PAUSE)
                    pause_at = np.inf
            recorder.steps(0.3, patch, TEACHING_FORCE)
            recorder.steps(0.5)
        yield recorder.episode(index, GRASP)
    env.close()
