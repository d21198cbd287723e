"""Figures of where the robot goes when it is touched, and of the demonstrations that lead it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hasm_torch.evaluation.along_force import motion, resultant
from hasm_torch.evaluation.plots import plt, save
from hasm_torch.evaluation.rollout import Array, Trace
from hasm_torch.sim.render import EXTENTS

AXES = {"top": (0, 1), "side": (0, 2)}  # of ``odom`` in the pictures of these cameras
ARROW = 0.02  # m for each newton
HALF_WIDTH = 0.45  # m, of what is shown about the touched point


class View(NamedTuple):
    """A rollout to be drawn.

    Attributes:
        trace: The rollout.
        patch: Patch that is touched.
        pictures: Picture by camera, the robot at the beginning and the end of the touch in one;
            empty where nothing can be rendered.
    """

    trace: Trace
    patch: str
    pictures: Mapping[str, NDArray[np.uint8]]


def plot_yield(path: Path, views: Sequence[View]) -> None:
    """Force and way of the touched point from the top and from the side, a column a rollout.

    Args:
        path: PNG to write.
        views: The rollouts.
    """
    figure, axes = plt.subplots(
        len(AXES), len(views), figsize=(4.2 * len(views), 8.2), squeeze=False
    )
    for column, view in zip(axes.T, views):
        force, point, _ = resultant(view.trace)
        rows = np.flatnonzero(np.isfinite(point[:, 0]) & (np.linalg.norm(force, axis=1) > 0))
        shown = rows[:: max(1, len(rows) // 6)]
        measured = motion(view.trace)
        for axis, (camera, (x, y)) in zip(column, AXES.items()):
            if camera in view.pictures:
                axis.imshow(view.pictures[camera], extent=EXTENTS[camera], alpha=0.6)
            axis.plot(point[rows, x], point[rows, y], color="tab:blue", linewidth=2.5,
                      label="way of the touched point")  # fmt: skip
            axis.plot(*point[rows[0], [x, y]], "o", color="white", markeredgecolor="tab:blue")
            axis.plot(*point[rows[-1], [x, y]], "o", color="tab:blue")
            axis.quiver(
                *(point[shown, x], point[shown, y], force[shown, x], force[shown, y]),
                angles="xy", scale_units="xy", scale=1 / ARROW, pivot="tip", color="tab:red",
                width=0.008, label=f"force, {ARROW * 1e3:g} mm a newton",
            )  # fmt: skip
            middle = point[rows].mean(axis=0)
            axis.set_xlim(middle[x] - HALF_WIDTH, middle[x] + HALF_WIDTH)
            axis.set_ylim(middle[y] - HALF_WIDTH, middle[y] + HALF_WIDTH)
            axis.set_aspect("equal")
            axis.set_xlabel("x in odom (m)")
            axis.set_ylabel(f"{'xyz'[y]} in odom (m)")
        column[0].set_title(
            f"{view.patch}, {measured.force:.1f} N\ncos {measured.cos:.2f}, "
            f"{100 * measured.travel:.1f} cm along the force",
            fontsize=10,
        )
    axes[0, 0].legend(fontsize=8, loc="best")
    save(figure, path)


def plot_shares(path: Path, curves: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """Share of pushes that move with the force, and their cosine, against demonstrations.

    Args:
        path: PNG to write.
        curves: ``along_force`` figures by number of demonstrations, by whose they are; with
            ``share_07_of_teacher_interval`` bars are drawn.
    """
    figure, axes = plt.subplots(1, 2, figsize=(10, 4))
    for name, curve in curves.items():
        sizes = [int(size) for size in curve]
        for axis, key in zip(axes, ("share_07_of_teacher", "cos_median")):
            line = axis.plot(sizes, [f[key] for f in curve.values()], marker="o", label=name)
            bars = [f.get(f"{key}_interval") for f in curve.values()]
            if None not in bars:
                low, high = np.array(bars, dtype=np.float64).T
                axis.fill_between(sizes, low, high, color=line[0].get_color(), alpha=0.15)
    for axis, label in zip(
        axes,
        ("share within 45° of the force\nover the demonstrator's own (1)",
         "F·v / |F||v|, median over pushes (1)"),
    ):  # fmt: skip
        axis.set_xscale("log")
        ticks = sorted({int(size) for curve in curves.values() for size in curve})
        axis.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        axis.minorticks_off()
        axis.set_xlabel("demonstrations (episodes of four pushes)")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.suptitle("Yield in unseen postures")
    save(figure, path)


def plot_weights(
    path: Path,
    weights: Array,
    origins: NDArray[np.int64],
    postures: Array,
    here: Array,
    joints: Sequence[str],
) -> None:
    """Which demonstrations take part in one soft recall.

    Args:
        path: PNG to write.
        weights: (K,) recall weight of every association.
        origins: (K, 3) episode, sample and patch from which each comes.
        postures: (K, 2) two joints at these samples, rad.
        here: (2,) the same joints of the robot.
        joints: Names of these joints.
    """
    episodes = np.bincount(origins[:, 0], weights)
    taking = float(np.exp(-np.sum(episodes[episodes > 0] * np.log(episodes[episodes > 0]))))
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4))
    left.bar(np.arange(len(episodes)), episodes, width=1.0, color="tab:blue")
    left.set_xlabel("stored episode")
    left.set_ylabel("recall weight of its samples together (1)")
    left.set_title(f"one recall: as if {taking:.1f} demonstrations took part", fontsize=10)
    order = np.argsort(weights)
    size = 400 * np.sqrt(weights[order] / weights.max())
    shown = right.scatter(
        *postures[order].T, s=np.maximum(size / 4, 1), c=weights[order], cmap="viridis", alpha=0.8
    )
    right.plot(*here, marker="*", color="tab:red", markersize=16, label="the robot")
    figure.colorbar(shown, ax=right, label="recall weight of a sample (1)")
    right.set_xlabel(f"{joints[0]} (rad)")
    right.set_ylabel(f"{joints[1]} (rad)")
    right.set_title("postures of the stored samples", fontsize=10)
    right.legend(fontsize=8)
    save(figure, path)


def plot_moved(
    path: Path,
    tested: Mapping[str, Sequence[Sequence[float]]],
    taught: Mapping[str, Sequence[tuple[float, float]]],
) -> None:
    """Where the object stood and whether it was lifted, a panel a largest offset.

    Args:
        path: PNG to write.
        tested: By largest offset (m): x and y (m) and success of each rollout.
        taught: By largest offset: x and y of the demonstrations, m.
    """
    figure, axes = plt.subplots(1, len(tested), figsize=(4.2 * len(tested), 4.4), squeeze=False)
    for axis, (reach, places) in zip(axes[0], tested.items()):
        x, y, lifted = np.array(places, dtype=np.float64).T
        axis.plot(*(100 * np.array(taught[reach])).T, "x", color="black", label="taught")
        for won, colour, label in ((1, "tab:green", "lifted"), (0, "tab:red", "missed")):
            some = lifted == won
            axis.scatter(100 * x[some], 100 * y[some], s=40, color=colour, label=label)
        axis.set_title(f"up to {100 * float(reach):g} cm: {np.mean(lifted):.0%} lifted")
        axis.set_xlabel("object displaced along x (cm)")
        axis.set_ylabel("along y (cm)")
        axis.set_aspect("equal")
        axis.set_xlim(-12, 12)
        axis.set_ylim(-12, 12)
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8, loc="upper left")
    save(figure, path)
