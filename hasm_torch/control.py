"""Walking through a memory, spike by spike.

The reference is the joint state that the robot is asked to take. A spike of a touched patch moves
it along the straight segment to the recalled successor by 1/pace of a joint range; at the
successor the next one is recalled. Without spikes nothing moves, so the robot holds still.
"""

from collections import deque
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hasm_torch.patch_memory import PatchMemory
from hasm_torch.skin_encoder import SkinState

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
    """

    positions: Tensor
    pace: float


@dataclass
class Walk:
    """Where one robot is in its memories.

    Attributes:
        reference: (joints,) the joint state asked for, None before the first valid reading.
        goals: The successor that each patch is heading for.
        quiet: Control steps since each patch last spiked.
    """

    reference: Tensor | None = None
    goals: dict[str, Goal] = field(default_factory=dict)
    quiet: dict[str, int] = field(default_factory=dict)


@dataclass
class Rollout:
    """What one robot's control loop needs to go on; several robots can share the memories.

    Attributes:
        spikes: Spikes of every patch in the last control steps, (patches,) each.
        density: (patches,) rate density ρ of every patch at the last step.
        touched: Patches with a memory that spiked in the last step.
        skin: State of the skin's encoder.
        walk: Where the robot is in the memories.
    """

    spikes: deque[Tensor]
    density: Tensor
    touched: list[str] = field(default_factory=list)
    skin: SkinState | None = None
    walk: Walk = field(default_factory=Walk)


def advance(
    reference: Tensor,
    walk: Walk,
    patch: str,
    memory: PatchMemory,
    spikes: float,
    density: Tensor,
    link: Tensor | None = None,
) -> Tensor:
    """Move the reference by a number of spikes of one patch.

    Args:
        reference: (joints,) joint positions, rad or m.
        walk: Holds the patch's goal between calls.
        patch: Name of the patch.
        memory: The patch's memory.
        spikes: Spikes to spend.
        density: () rate density ρ of the patch.
        link: (3, 3) rotation of the patch's link, see ``PatchMemory.codes``.

    Returns:
        (joints,) the moved reference; joints that the memory does not code stay.
    """
    coded = reference[memory.joints]
    span = memory.place_code.upper - memory.place_code.lower
    for _ in range(RECALLS_A_STEP):
        goal = walk.goals.get(patch)
        if goal is None:
            positions, pace = memory(coded, density, link)
            goal = walk.goals[patch] = Goal(positions, float(pace))
        way = goal.positions - coded
        needed = goal.pace * float((way / span).abs().max())
        if needed > spikes:
            coded = coded + way * (spikes / needed)
            break
        coded, spikes = goal.positions, spikes - needed
        del walk.goals[patch]
        if needed == 0 or spikes == 0:
            break
    moved = reference.clone()
    moved[memory.joints] = coded
    return moved


def limit_speed(before: Tensor, after: Tensor, max_speed: Tensor, period: float) -> Tensor:
    """Shorten a step, keeping its direction, so that no joint is asked to exceed its speed limit.

    Args:
        before: (..., joints) positions now, rad or m.
        after: (..., joints) positions wanted a control step later, rad or m.
        max_speed: (joints,) speed limits, rad/s or m/s.
        period: Duration of a control step, s.

    Returns:
        (..., joints) positions that the limits allow.
    """
    share = ((after - before).abs() / (SPEED_SHARE * max_speed * period)).amax(-1, keepdim=True)
    return before + (after - before) / torch.clamp(share, min=1.0)
