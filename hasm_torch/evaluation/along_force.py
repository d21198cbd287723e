"""Does the touched point go where it is pushed? The physical figures of every touch.

With F the force that the fingers really applied and dp the way of the touched point of the skin
in one control step, both in ``odom``, over the control steps in which the skin is pressed:

    cos    = Σ F·dp / Σ |F| |dp|        1: every step along the force, -1: every step against it
    travel = Σ F·dp / |F|               m along the force

Two fingers count as one: their resultant at the mean of their points, weighted by their forces.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hasm_torch.evaluation.rollout import Array, Trace

SETTLED_AFTER = 0.3  # s from the first contact until the robot follows the touch
PRESSED = 0.5  # N, less than that is no push
MOVED = 0.002  # m: a robot that holds still gives way by less under a changing push
ALONG = 0.7  # cos of what counts as with the force, within 45 degrees of it


class Motion(NamedTuple):
    """Way of the touched point in one rollout.

    Attributes:
        cos: Cosine of way and force; 0 where the point goes less than ``MOVED``.
        travel: Way along the force, m.
        force: Mean force, N.
        speed: Mean speed along the force, m/s.
        moved: Largest distance from where it began, m.
    """

    cos: float
    travel: float
    force: float
    speed: float
    moved: float


def resultant(trace: Trace) -> tuple[Array, Array, Array]:
    """What both fingers do together.

    Where the same cells stay pressed, the weights of their points stay too, so that the point is
    one of the skin; a finger counts by its mean force.

    Args:
        trace: A rollout.

    Returns:
        (T, 3) resultant force, N; (T, 3) point, m, NaN without touch; (T,) number of the spell in
        which the same cells are pressed.
    """
    same = (trace.patch[1:] == trace.patch[:-1]) & (trace.cell[1:] == trace.cell[:-1])
    spell = np.concatenate([[0], np.cumsum(~same.all(axis=1))])
    size = np.linalg.norm(trace.force, axis=2)
    touching = trace.patch != ""
    point = np.full(trace.force.shape[::2], np.nan)
    for number in np.unique(spell[touching.any(axis=1)]):
        rows = spell == number
        used = touching[rows][0]
        weight = size[rows][:, used].mean(axis=0)
        weight = weight / weight.sum() if weight.any() else np.full(used.sum(), 1 / used.sum())
        point[rows] = np.einsum("f,tfx->tx", weight, trace.point[rows][:, used])
    return trace.force.sum(axis=1), point, spell


def motion(trace: Trace, plane: bool = False, point: Array | None = None) -> Motion:
    """Measure one rollout.

    Args:
        trace: The rollout.
        plane: Whether x and y alone count.
        point: (T, 3) what moves in place of the touched point, m.
    """
    force, touched, spell = resultant(trace)
    place = touched if point is None else point
    if plane:
        force, place = force[:, :2], place[:, :2]
    size = np.linalg.norm(force, axis=1)
    pressed = size > PRESSED
    if not pressed.any():
        return Motion(0.0, 0.0, 0.0, 0.0, 0.0)
    ready = trace.time[pressed.argmax()] + SETTLED_AFTER
    rows = 1 + np.flatnonzero(
        pressed[1:] & pressed[:-1] & (spell[1:] == spell[:-1]) & (trace.time[:-1] >= ready - 1e-9)
    )
    if not rows.size:
        return Motion(0.0, 0.0, 0.0, 0.0, 0.0)
    step, size = place[rows] - place[rows - 1], size[rows]
    along = np.einsum("tx,tx->t", force[rows], step)
    travel = float((along / size).sum())
    moved = float(np.linalg.norm(place[rows] - place[rows[0] - 1], axis=1).max())
    whole = float((size * np.linalg.norm(step, axis=1)).sum())
    seconds = float((trace.time[rows] - trace.time[rows - 1]).sum())
    return Motion(
        cos=float(along.sum()) / whole if moved >= MOVED else 0.0,
        travel=travel,
        force=float(size.mean()),
        speed=travel / seconds,
        moved=moved,
    )


def summarise(mine: Sequence[Motion], teacher: Sequence[Motion]) -> dict[str, Any]:
    """The figures over many rollouts.

    Args:
        mine: Motions of a policy.
        teacher: Motions of the demonstrator's own law on the same cases.

    Returns:
        ``rollouts``; ``cos_median``; ``share_07``, of rollouts within 45° of the force;
        ``share_07_of_teacher``, that over the teacher's own share; ``against``, share of rollouts
        that move against the force; ``travel_of_teacher``, median over the rollouts in which the
        teacher moves with the force of the way along it over the teacher's. A figure that has
        nothing to stand on is None.
    """
    share, share_of_teacher = (float(np.mean([m.cos > ALONG for m in s])) for s in (mine, teacher))
    cosines = np.array([m.cos for m in mine])
    travels = [m.travel / t.travel for m, t in zip(mine, teacher, strict=True) if t.cos > ALONG]
    return {
        "rollouts": len(mine),
        "cos_median": float(np.median(cosines)),
        "share_07": share,
        "share_07_of_teacher": share / share_of_teacher if share_of_teacher else None,
        "against": float(np.mean(cosines < 0)),
        "travel_of_teacher": float(np.median(travels)) if travels else None,
    }
