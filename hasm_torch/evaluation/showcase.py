"""Rollouts that are shown: figures and videos of both experiments."""

from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.apps.rerun_recording import Scenes, cell_places, write_recording
from hasm_torch.evaluation import plots
from hasm_torch.evaluation.compliance import BEHAVIOURS, ComplianceCase
from hasm_torch.evaluation.grasp import GraspCase
from hasm_torch.evaluation.rollout import Array, roll_out
from hasm_torch.evaluation.runner import make_env, run_case
from hasm_torch.evaluation.video import caption, write_video
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.poses import START_POSES

FRAME_EVERY = 2  # control steps, so that videos run at half the control rate
SHOWN_JOINT = "arm_flex_joint"
# (begin s, end s, patch, lowest N, highest N): two pushes each way, the second pair harder.
SCRIPT = (
    (0.3, 1.8, "wrist_upper", 2.0, 6.0),
    (2.3, 3.5, "wrist_upper", 4.0, 12.0),
    (4.2, 5.7, "wrist_under", 2.0, 6.0),
    (6.2, 7.4, "wrist_under", 4.0, 12.0),
)


class _Script:
    """A human who follows ``SCRIPT``, each push swelling and fading."""

    def touch(self, time: float, state: Array) -> tuple[str | None, float]:
        for begin, end, patch, low, high in SCRIPT:
            if begin <= time < end:
                swell = np.sin(np.pi * (time - begin) / (end - begin)) ** 2
                return patch, low + (high - low) * float(swell)
        return None, 0.0

    def finished(self, time: float, state: Array) -> bool:
        return time >= SCRIPT[-1][1] + 0.6


def draw_compliance(model: HASM, metrics: dict[str, Any], directory: Path) -> list[Path]:
    """The figure of the paper, and force against speed.

    Args:
        model: Model trained on the compliance episodes.
        metrics: Figures of the rollouts.
        directory: Where the figures go.

    Returns:
        The figures written.
    """
    env = make_env("compliance")
    start = np.array(START_POSES["compliance"])
    trace = roll_out(env, model, _Script(), start, seed=0)
    joint = JOINTS.index(SHOWN_JOINT)
    trajectory, force_speed = directory / "compliance.png", directory / "force_speed.png"
    plots.plot_trajectory(
        trajectory,
        trace.time,
        trace.state[:, joint],
        trace.force,
        trace.velocity[:, joint],
        trace.patch,
        SHOWN_JOINT,
    )
    plots.plot_force_speed(force_speed, metrics["behaviours"])
    env.close()
    return [trajectory, force_speed]


def draw_grasp(model: HASM, seed: int, directory: Path) -> list[Path]:
    """The recall weights over the stored sequences through one grasp.

    Args:
        model: Model trained on the grasp episodes.
        seed: Seed of the rollout.
        directory: Where the figure goes.

    Returns:
        The figure written.
    """
    env = make_env("grasp")
    recalled: list[tuple[str, Array] | None] = []

    def watch(_: Any) -> None:
        recalled.append(_weights(model))

    case = GraspCase(seed, 2, 0.05, 0.01, 7.0)
    trace, _ = run_case("grasp", case, env, model, watch=watch)
    path = directory / "recall_weights.png"
    plots.plot_recall(path, trace.time, recalled, sorted(model.patches))
    env.close()
    return [path]


def record(experiment: str, model: HASM, seed: int, directory: Path) -> Path:
    """A recording of one rollout for the Rerun viewer.

    Args:
        experiment: "compliance" or "grasp".
        model: The model.
        seed: Seed of the rollout.
        directory: Where the recording goes.

    Returns:
        The recording written.
    """
    env = make_env(experiment)
    spikes: list[Array] = []
    recalled: list[tuple[str, Array] | None] = []

    def watch(_: Any) -> None:
        recalled.append(_weights(model))
        spikes.append(model.rollout.spikes[-1])

    if experiment == "compliance":
        start = np.array(START_POSES[experiment])
        trace = roll_out(env, model, _Script(), start, seed, watch=watch)
    else:
        case = GraspCase(seed, 2, 0.05, 0.01, 7.0)
        trace, _ = run_case(experiment, case, env, model, watch=watch)
    env.close()
    joints, patches = list(JOINTS), list(model.body.patches)
    scenes = Scenes(
        trace.time, joints, trace.state, trace.skin, patches, np.array(spikes), recalled
    )
    scenes.cells = cell_places(joints, trace.state)
    path = directory / f"{experiment}.rrd"
    write_recording(path, scenes, f"hasm_{experiment}")
    return path


def _weights(model: HASM) -> tuple[str, Array] | None:
    touched = model.touched
    if not touched:
        return None
    memory = model.memory(touched[0])
    positions = model.reference[memory.joints]
    density = model.density[model.body.patches.index(touched[0])]
    link = model.link_rotation(touched[0], model.reference)
    return touched[0], memory.weights(positions, density, link, touched[0]).double().numpy()


def film(experiment: str, model: HASM, seed: int, directory: Path) -> Path:
    """A video of an experiment; touched cells light up.

    Args:
        experiment: "compliance" or "grasp".
        model: The model.
        seed: Seed of the rollouts.
        directory: Where the video goes.

    Returns:
        The video written.

    Raises:
        RuntimeError: If there is no OpenGL to draw with.
    """
    env = make_env(experiment, render=True)
    frames = []
    try:
        if experiment == "compliance":
            for index in range(len(BEHAVIOURS)):
                frames += _clip(env, model, ComplianceCase(index, seed, 8.0, True))
        else:
            frames += _clip(env, model, GraspCase(seed, 2, 0.05, 0.01, 8.0))
    finally:
        env.close()
    path = directory / f"{experiment}.mp4"
    write_video(path, frames, env.metadata["render_fps"] // FRAME_EVERY)
    return path


def _clip(env: Any, model: HASM, case: Any) -> list[Any]:
    experiment = "compliance" if isinstance(case, ComplianceCase) else "grasp"
    start = np.array(START_POSES[experiment]) if experiment == "compliance" else None
    trace, _ = run_case(experiment, case, env, model, frame_every=FRAME_EVERY, start=start)
    clip = []
    for i, frame in enumerate(trace.frames):
        row = FRAME_EVERY * (i + 1) - 1
        patch, force = trace.patch[row], trace.force[row]
        text = f"{patch}  {force:.1f} N" if patch else "no touch"
        clip.append(caption(frame, f"{trace.time[row]:5.2f} s   {text}"))
    return clip
