"""Figures of an evaluation, drawn with matplotlib."""

from pathlib import Path
from typing import Any

from hasm_torch._extras import require

require("viz")

import matplotlib  # noqa: E402

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from hasm_torch.evaluation.rollout import Trace  # noqa: E402
from hasm_torch.robot import JOINTS  # noqa: E402

Array = NDArray[np.float64]

PATCH_COLOURS = {
    "wrist_upper": "tab:orange",
    "wrist_under": "tab:blue",
    "wrist_left": "tab:green",
    "wrist_right": "tab:red",
}


def plot_trajectory(path: Path, trace: Trace, joint: int) -> None:
    """Joint trajectory, force and joint speed over time, the touched patches shaded.

    Args:
        path: PNG to write.
        trace: A rollout in which one finger touches.
        joint: Index into ``JOINTS``.
    """
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 6.5))
    series = {
        f"{JOINTS[joint]}\nposition (rad)": trace.state[:, joint],
        "force on the skin\n(N)": trace.strength,
        "joint speed\n(rad/s)": trace.velocity[:, joint],
    }
    touched = trace.patch[:, 0]
    for axis, (label, values) in zip(axes, series.items()):
        for patch in dict.fromkeys(filter(None, touched.tolist())):
            whole = {"transform": axis.get_xaxis_transform(), "linewidth": 0, "label": patch}
            colour = PATCH_COLOURS[patch]
            axis.fill_between(trace.time, 0, 1, touched == patch, color=colour, alpha=0.2, **whole)
        axis.plot(trace.time, values, color="black", linewidth=1.2)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("time (s)")
    axes[0].legend(loc="best", title="touched patch")
    axes[0].set_title("Pseudo-compliance: the joint yields to the touch, faster the harder it is")
    save(figure, path)


def plot_force_speed(path: Path, behaviours: dict[str, dict[str, Any]]) -> None:
    """Force against mean joint speed with a straight line through them, a panel a behaviour.

    Args:
        path: PNG to write.
        behaviours: As in ``metrics.json``.
    """
    figure, axes = plt.subplots(1, len(behaviours), figsize=(3.4 * len(behaviours), 3.4))
    for axis, (name, figures) in zip(np.atleast_1d(axes), behaviours.items()):
        points = np.array(figures["velocities"]).reshape(-1, 2)
        axis.scatter(points[:, 0], points[:, 1], s=14, color="tab:blue")
        if len(points) > 1 and np.ptp(points[:, 0]) > 0:
            slope, offset = np.polyfit(points[:, 0], points[:, 1], 1)
            ends = np.array([points[:, 0].min(), points[:, 0].max()])
            axis.plot(ends, slope * ends + offset, color="black", linewidth=1)
        axis.set_title(
            f"{name}\nR² {figures['r2']:.3f}, rank correlation {figures['spearman']:.3f}",
            fontsize=9,
        )
        axis.set_xlabel("force (N)")
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_ylabel("mean joint speed (rad/s)")
    save(figure, path)


def plot_recall(
    path: Path,
    time: Array,
    weights: list[tuple[str, Array] | None],
    names: list[str],
    rows: str = "stored association",
) -> None:
    """Recall weights through a rollout, a panel a patch.

    Args:
        path: PNG to write.
        time: (T,) s.
        weights: (T,) patch and (K,) softmax weights, or None without touch.
        names: Patches to draw.
        rows: What the K weights belong to.
    """
    figure, axes = plt.subplots(len(names), 1, sharex=True, figsize=(9, 2.8 * len(names)))
    for axis, name in zip(np.atleast_1d(axes), names):
        found = [(i, w[1]) for i, w in enumerate(weights) if w is not None and w[0] == name]
        if found:
            count = len(found[0][1])
            image = np.full((count, len(time)), np.nan)
            for i, column in found:
                image[:, i] = column
            shown = axis.imshow(
                image,
                aspect="auto",
                origin="lower",
                interpolation="nearest",
                extent=(time[0], time[-1], 0, count),
                cmap="viridis",
                vmin=0,
            )
            figure.colorbar(shown, ax=axis, label="softmax weight")
        axis.set_ylabel(f"{name}\n{rows}")
    np.atleast_1d(axes)[-1].set_xlabel("time (s); blank where the patch is not touched")
    np.atleast_1d(axes)[0].set_title("Recall weights through a grasp")
    save(figure, path)


def plot_prediction(
    path: Path,
    frames: Array,
    real: Array,
    predicted: dict[str, Array],
    joints: list[tuple[str, str]],
    title: str,
) -> None:
    """Predicted and real joint positions through some episodes, a panel a joint.

    Args:
        path: PNG to write.
        frames: (T,) s; NaN between episodes breaks the lines.
        real: (T, joints) what came, in the joints' units.
        predicted: (T, joints) what was predicted, by the name of who predicted it.
        joints: Name and unit of every joint to draw.
        title: Heading.
    """
    figure, axes = plt.subplots(len(joints), 1, sharex=True, figsize=(9, 1.8 * len(joints)))
    for j, (axis, (name, unit)) in enumerate(zip(np.atleast_1d(axes), joints)):
        axis.plot(frames, real[:, j], color="black", linewidth=1.5, label="real")
        for (who, values), colour in zip(predicted.items(), ("tab:orange", "tab:blue")):
            axis.plot(frames, values[:, j], color=colour, linewidth=1.0, label=who)
        axis.set_ylabel(f"{name}\n({unit})", fontsize=8)
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_title(title)
    np.atleast_1d(axes)[0].legend(loc="best", fontsize=8)
    np.atleast_1d(axes)[-1].set_xlabel("time (s), held-out episodes one after the other")
    save(figure, path)


def save(figure: Any, path: Path) -> None:
    """Write a figure and let go of it."""
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
