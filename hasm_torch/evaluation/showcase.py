"""Rollouts that are shown in figures and recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hasm_torch.evaluation import plots, teaching, touch_plots, yielding
from hasm_torch.evaluation.grasp import GraspCase
from hasm_torch.evaluation.options import EvalConfig
from hasm_torch.evaluation.push import Push, Pushes
from hasm_torch.evaluation.rollout import Array, roll_out, run_case
from hasm_torch.evaluation.runner import make_env
from hasm_torch.evaluation.suite import MOVED
from hasm_torch.evaluation.viewer import Scenes, cell_places, write_recording
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.sim.tasks import FAR, GRASP_PATCH, OBJECT_PLACES, REACH_PATCH, START_POSES

SHOWN_JOINT = "arm_flex_joint"

# Two swelling and fading pushes each way, the second pair harder: (s, s, patch, N, N).
SCRIPT = Pushes(
    [
        Push({patch: (middle, None)}, begin, end, 0.6, swing, end - begin, phase=-np.pi / 2)
        for begin, end, patch, middle, swing in (
            (0.3, 1.8, "wrist_upper", 4.0, 2.0),
            (2.3, 3.5, "wrist_upper", 8.0, 4.0),
            (4.2, 5.7, "wrist_under", 4.0, 2.0),
            (6.2, 7.4, "wrist_under", 8.0, 4.0),
        )
    ]
)
YIELD_VIEWS = 3
LEAST_SHOWN = 6.0  # N, so that a way can be seen
POSTURE_JOINTS = ("arm_flex_joint", "arm_roll_joint")


def draw_compliance(
    config: EvalConfig, model: HASM, metrics: Mapping[str, Any], directory: Path
) -> list[Path]:
    """The figure of the paper, and force against speed; see ``draw_yield``."""
    env = make_env("compliance")
    trace = roll_out(env, model, SCRIPT, np.array(START_POSES["compliance"]), seed=0)
    env.close()
    trajectory, force_speed = directory / "compliance.png", directory / "force_speed.png"
    plots.plot_trajectory(trajectory, trace, JOINTS.index(SHOWN_JOINT))
    plots.plot_force_speed(force_speed, metrics["behaviours"])
    return [trajectory, force_speed]


def draw_yield(
    config: EvalConfig, model: HASM, metrics: Mapping[str, Any], directory: Path
) -> list[Path]:
    """Pushes from two sides, one soft recall, and shares against demonstrations.

    Args:
        config: What is evaluated.
        model: Model of the experiment.
        metrics: Figures of its rollouts.
        directory: Where the figures go.

    Returns:
        The figures written.
    """
    cases = yielding.cases(100, config.seed, kinds=("even",))
    strong = {next(iter(c.push.pressed)): c for c in cases if _strength(c) > LEAST_SHOWN}
    env = _env_with_pictures()
    shown = list(strong.items())[:YIELD_VIEWS]
    seen = [_watched(env, model, patch, case) for patch, case in shown]
    env.close()
    paths = [directory / "yield.png"]
    touch_plots.plot_yield(paths[0], [view for view, _ in seen])
    if "episodes" in metrics:
        paths.append(directory / "yield_episodes.png")
        touch_plots.plot_shares(paths[-1], {"memory": metrics["episodes"]})
    recalls = seen[0][1]
    weights, reference = recalls[len(recalls) // 2]
    joints = [JOINTS.index(joint) for joint in POSTURE_JOINTS]
    postures = np.array([model.posture(row)[joints] for row in range(len(weights))])
    paths.append(directory / "yield_recall.png")
    touch_plots.plot_weights(
        paths[-1], weights, model.origins, postures, reference[joints], POSTURE_JOINTS
    )
    return paths


def draw_grasp(
    config: EvalConfig, model: HASM, metrics: Mapping[str, Any], directory: Path
) -> list[Path]:
    """Recall weights over the stored motions through one grasp, and moved objects; see above."""
    env = make_env("grasp")
    recalled = _Recalled(model)
    case = GraspCase(config.seed, 7.0, (FAR / 2, -FAR / 2), pauses=2)
    trace, _ = run_case(case, env, model, recalled)
    env.close()
    paths = [directory / "recall_weights.png"]
    plots.plot_recall(paths[0], trace.time, recalled.weights, [REACH_PATCH, GRASP_PATCH])
    if "moved_results" in metrics:
        places = {
            f"{reach:.2f}": OBJECT_PLACES[: teaching.NEAR_PLACES]
            if choice is teaching.near_places
            else OBJECT_PLACES[teaching.NEAR_PLACES :]
            for reach, choice in MOVED.items()
        }
        paths.append(directory / "moved_object.png")
        touch_plots.plot_moved(paths[-1], metrics["moved_results"], places)
    return paths


def record(experiment: str, model: HASM, seed: int, directory: Path) -> Path:
    """A recording of one rollout for the Rerun viewer.

    Args:
        experiment: The experiment.
        model: The model.
        seed: Seed of the rollout.
        directory: Where the recording goes.

    Returns:
        The recording written.
    """
    env = make_env(experiment)
    spikes: list[Array] = []
    skin: list[Array] = []
    recalled = _Recalled(model)

    def watch() -> None:
        recalled()
        spikes.append(model.rollout.spikes[-1])
        skin.append(env.unwrapped.skin_forces)

    if experiment == "compliance":
        start = np.array(START_POSES[experiment])
        trace = roll_out(env, model, SCRIPT, start, seed, watch=watch)
    elif experiment == "yield":
        [case] = yielding.cases(1, seed)
        trace, _ = run_case(case, env, model, watch)
    else:
        trace, _ = run_case(GraspCase(seed, 7.0, pauses=2), env, model, watch)
    env.close()
    joints, patches = list(JOINTS), list(model.body.patches)
    scenes = Scenes(
        trace.time, joints, trace.state, np.array(skin), patches, np.array(spikes), recalled.weights
    )
    scenes.cells = cell_places(joints, trace.state)
    path = directory / f"{experiment}.rrd"
    write_recording(path, scenes, f"hasm_{experiment}")
    return path


class _Recalled:
    """Notes after every step what was recalled last for the patch that is touched.

    Attributes:
        weights: Patch and weights of each step, None without touch.
    """

    def __init__(self, model: HASM) -> None:
        self._model = model
        self._last: dict[str, Array] = {}
        self.weights: list[tuple[str, Array] | None] = []

    def __call__(self) -> None:
        self._last |= dict(self._model.recalled())
        known = [patch for patch in self._model.touched if patch in self._last]
        self.weights.append((known[0], self._last[known[0]]) if known else None)


def _watched(
    env: Any, model: HASM, patch: str, case: yielding.YieldCase
) -> tuple[touch_plots.View, list[tuple[Array, Array]]]:
    """A push with pictures of its beginning and end; weights and reference of every recall."""
    recalls: list[tuple[Array, Array]] = []
    pictures: dict[str, list[Any]] = {camera: [] for camera in touch_plots.AXES}
    sim, ends = env.unwrapped, (case.push.begin, case.push.end)

    def watch() -> None:
        for _, weights in model.recalled():
            recalls.append((weights, model.reference.double().numpy()))
        if sim.render_mode and np.abs(np.subtract(ends, sim.data.time)).min() < 0.01:
            for camera, taken in pictures.items():
                taken.append(sim.render(camera))

    trace, _ = run_case(case.without_rest(), env, model, watch)
    both = {c: np.mean(taken, axis=0).astype(np.uint8) for c, taken in pictures.items() if taken}
    return touch_plots.View(trace, patch, both), recalls


def _strength(case: yielding.YieldCase) -> float:
    return max(force for force, _ in case.push.pressed.values())


def _env_with_pictures() -> Any:
    """An environment that renders, or one that does not where nothing can."""
    env = make_env("yield", render=True)
    try:
        env.reset()
        env.render()
    except RuntimeError:
        env.close()
        return make_env("yield")
    return env
