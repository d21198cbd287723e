"""Videos of rollouts, in which touched cells light up."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.evaluation.compliance import ComplianceCase, even_push
from hasm_torch.evaluation.grasp import GraspCase
from hasm_torch.evaluation.push import Push, Pushes, swelling
from hasm_torch.evaluation.rollout import Trace, roll_out, run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.evaluation.video import Frame, caption, write_video
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import Skin
from hasm_torch.sim.tasks import (
    BEHAVIOURS,
    FAR,
    START_POSES,
    TORSO_PATCHES,
    WRIST_PATCHES,
    random_posture,
)

FRAME_EVERY = 2  # control steps, so that videos run at half the control rate
POSTURES = 3  # of the yield video
PUSH_SECONDS, GAP_SECONDS = 1.2, 0.4
FORCE, GRASP_FORCE = 8.0, 11.0  # N


def film(experiment: str, model: HASM, seed: int, directory: Path) -> Path:
    """A video of an experiment.

    Args:
        experiment: "compliance": the four touches; "yield": pushes on wrist and torso in three
            postures; "grasp": the object 10 cm to either side.
        model: The model.
        seed: Seed of the rollouts.
        directory: Where the video goes.

    Returns:
        The video written.

    Raises:
        RuntimeError: If there is no OpenGL to draw with.
    """
    env = make_env(experiment, render=True)
    clips = {"compliance": _compliance, "yield": _yield, "grasp": _grasp}[experiment]
    try:
        frames = [frame for clip in clips(env, model, seed) for frame in clip]
    finally:
        env.close()
    path = directory / f"{experiment}.mp4"
    write_video(path, frames, env.metadata["render_fps"] // FRAME_EVERY)
    return path


class _Camera:
    """Takes a picture every ``FRAME_EVERY`` control steps."""

    def __init__(self, env: Any) -> None:
        self._env, self._steps = env, 0
        self.frames: list[Frame] = []

    def __call__(self) -> None:
        self._steps += 1
        if self._steps % FRAME_EVERY == 0:
            self.frames.append(self._env.render())

    def clip(self, trace: Trace, title: str) -> list[Frame]:
        """The pictures, with what happens in them written into each."""
        captioned = []
        for i, frame in enumerate(self.frames):
            row = FRAME_EVERY * (i + 1) - 1
            patch, force = trace.patch[row, 0], trace.strength[row]
            text = f"{patch}  {force:.1f} N" if patch else "no touch"
            captioned.append(caption(frame, f"{title}{trace.time[row]:5.2f} s   {text}"))
        return captioned


def _compliance(env: Any, model: HASM, seed: int) -> Iterator[list[Frame]]:
    start = np.array(START_POSES["compliance"])
    for index, behaviour in enumerate(BEHAVIOURS):
        push = swelling(even_push(behaviour, FORCE), np.random.default_rng(seed))
        camera = _Camera(env)
        case = ComplianceCase(index, seed, push)
        trace, _ = run_case(case, env, model, camera, start)
        yield camera.clip(trace, "")


def _yield(env: Any, model: HASM, seed: int) -> Iterator[list[Frame]]:
    rng, skin = np.random.default_rng(seed), Skin.load()
    limits = env.unwrapped.joint_lower, env.unwrapped.joint_upper
    for number in range(POSTURES):
        order = [*rng.permutation(WRIST_PATCHES)[:3], *rng.permutation(TORSO_PATCHES)[:2]]
        cells = [skin.slices[patch].stop - skin.slices[patch].start for patch in order]
        stops = [(str(patch), int(rng.integers(count))) for patch, count in zip(order, cells)]
        pushes = []
        for turn, i in enumerate((0, 3, 1, 4, 2)):  # wrist and torso, so that both move in turn
            patch, cell = stops[i]
            begin = turn * (PUSH_SECONDS + GAP_SECONDS) + GAP_SECONDS
            end = begin + PUSH_SECONDS
            pushes.append(Push({patch: (FORCE, cell)}, begin, end, rest=GAP_SECONDS))
        camera = _Camera(env)
        start = random_posture(*limits, rng)
        trace = roll_out(env, model, Pushes(pushes), start, seed, watch=camera)
        yield camera.clip(trace, f"posture {number + 1}   ")


def _grasp(env: Any, model: HASM, seed: int) -> Iterator[list[Frame]]:
    for side in (-FAR, FAR):
        camera = _Camera(env)
        case = GraspCase(seed, GRASP_FORCE, (side, side), pauses=1)
        trace, _ = run_case(case, env, model, camera)
        yield camera.clip(trace, f"object {100 * side:+.0f} cm   ")
