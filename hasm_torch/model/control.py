"""Walking through a memory, spike by spike.

The reference is the joint state that the robot is asked to take. A spike of a touched patch moves
it along the straight segment to the recalled successor by 1/pace of a joint range; at the
successor the next one is recalled. Without spikes nothing moves, so the robot holds still.

A control step handles a few numbers at a time, which NumPy does in float64 and a fraction of the
time that tensors take.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.encoders.skin import SkinState
from hasm_torch.encoders.skin_filter import FilterState
from hasm_torch.model.patch_memory import PatchMemory

Array = NDArray[np.float64]

# A walk that needs more recalls than this in one control step waits for the next one, which
# bounds the time a step takes.
RECALLS_A_STEP = 4

# Of the joints' speed limits, this much is used: the servo that follows needs the rest.
SPEED_SHARE = 0.9


@dataclass
class Goal:
    """A recalled successor on the way to which the reference is.

    Attributes:
        positions: (J,) positions of the patch's joints, rad or m.
        pace: Spikes a full joint range.
        moved: (J,) which of the joints the touch moves.
    """

    positions: Array
    pace: float
    moved: NDArray[np.bool_]


@dataclass
class Walk:
    """Where one robot is in its memories.

    Attributes:
        reference: (joints,) the joint state asked for, None before the first valid reading.
        goals: The successor that each patch is heading for.
        levels: Stored rate density that stands for the touch of each patch.
        quiet: Control steps since each patch last spiked.
    """

    reference: Array | None = None
    goals: dict[str, Goal] = field(default_factory=dict)
    levels: dict[str, float] = field(default_factory=dict)
    quiet: dict[str, int] = field(default_factory=dict)


@dataclass
class Rollout:
    """What one robot's control loop needs to go on; several robots can share the memories.

    Attributes:
        spikes: Spikes of every patch in the last control steps, (patches,) each.
        density: (patches,) rate density ρ of every patch at the last step.
        touched: Patches with a memory that spiked in the last step.
        filter: State of what cleans the skin's readings.
        skin: State of the skin's encoder.
        walk: Where the robot is in the memories.
    """

    spikes: deque[Array]
    density: Array
    touched: list[str] = field(default_factory=list)
    filter: FilterState | None = None
    skin: SkinState | None = None
    walk: Walk = field(default_factory=Walk)


def advance(
    reference: Array,
    walk: Walk,
    patch: str,
    memory: PatchMemory,
    spikes: float,
    density: float,
    link: Tensor | None = None,
) -> Array:
    """Move the reference by a number of spikes of one patch.

    Args:
        reference: (joints,) joint positions, rad or m.
        walk: Holds the patch's goal and touch level between calls.
        patch: Name of the patch.
        memory: The patch's memory.
        spikes: Spikes to spend.
        density: Rate density ρ of the patch.
        link: (3, 3) rotation of the patch's link, see ``PatchMemory.codes``.

    Returns:
        (joints,) the moved reference; joints that the memory does not code stay.
    """
    coded = reference[memory.coded]
    level = walk.levels[patch] = memory.touch_level(density, walk.levels.get(patch))
    for _ in range(RECALLS_A_STEP):
        goal = walk.goals.get(patch)
        if goal is None:
            goal = walk.goals[patch] = Goal(*memory.follow(coded, level, link, patch))
        way = np.where(goal.moved, goal.positions - coded, 0.0)
        needed = goal.pace * float(np.abs(way / memory.span).max())
        if needed > spikes:
            coded = coded + way * (spikes / needed)
            break
        coded, spikes = np.where(goal.moved, goal.positions, coded), spikes - needed
        del walk.goals[patch]
        if needed == 0 or spikes == 0:
            break
    moved = reference.copy()
    moved[memory.coded] = coded
    return moved


def limit_speed(before: Array, after: Array, max_speed: Array, period: float) -> Array:
    """Shorten a step, keeping its direction, so that no joint is asked to exceed its speed limit.

    Args:
        before: (joints,) positions now, rad or m.
        after: (joints,) positions wanted a control step later, rad or m.
        max_speed: (joints,) speed limits, rad/s or m/s.
        period: Duration of a control step, s.

    Returns:
        (joints,) positions that the limits allow.
    """
    way = after - before
    share = float((np.abs(way) / (SPEED_SHARE * period * max_speed)).max())
    return after if share <= 1.0 else before + way / share
