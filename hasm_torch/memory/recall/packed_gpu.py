"""The packed scan on a GPU, as two Triton kernels.

``_scan`` gives every query and every part of the memory a program that goes over its rows with a
running softmax, as the CPU's scan does; ``_join`` joins the parts of a query.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

_FAR = tl.constexpr(1 << 29)  # distance of a row that takes no part
_LAST = tl.constexpr(1 << 62)  # row number after all others
_LOG_NEGLIGIBLE = tl.constexpr(27.726)  # -ln of the weight that may be dropped, 2^-40
_SHARPEST = tl.constexpr(1e4)  # beyond it only the nearest rows weigh, in float32

_TILE = 256  # rows a program looks at together, a multiple of 64
_MOST_PARTS = 1024  # of the memory, for one query
_PROGRAMS = 2048  # wanted to fill a large GPU


def scan_gpu(
    signs: Tensor,
    words: Tensor,
    successors: Tensor,
    beta: Tensor,
    count: Tensor,
    mask: Tensor | None,
    dim: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Recalls from a packed memory; every tensor contiguous and on the same GPU.

    Args:
        signs: Packed queries, complemented where β is negative, (*batch, queries, width) int32.
        words: (*batch, blocks, width, 64) int32.
        successors: (*batch, rows, values) float32.
        beta: () floating point.
        count: (*batch,) int64.
        mask: (*batch, queries, rows) bool.
        dim: Entries of a code.

    Returns:
        Decision (*batch, queries, values); row of the best match (*batch, queries) int64; its
        score, its margin and the entropy of the weights, (3, *batch, queries).
    """
    leading, (blocks, width) = signs.shape[:-1], words.shape[-3:-1]
    rows, values = successors.shape[-2:]
    numbers = leading.numel()
    tiles = -(-rows // _TILE)
    parts = max(1, min(_MOST_PARTS, tiles, -(-_PROGRAMS // max(1, numbers))))
    run = -(-tiles // parts) * _TILE
    columns = triton.next_power_of_2(values)

    device = successors.device
    places = torch.empty(3, numbers, parts, dtype=torch.int64, device=device)
    sums = torch.empty(numbers, parts, 2 + columns, dtype=torch.float64, device=device)
    decision = torch.empty(*leading, values, dtype=torch.float32, device=device)
    match = torch.empty(leading, dtype=torch.int64, device=device)
    certainty = torch.empty(3, *leading, dtype=torch.float32, device=device)
    if numbers == 0:
        return decision, match, certainty
    beta = beta.to(torch.float32)
    _scan[(numbers, parts)](
        signs,
        words,
        successors,
        beta,
        count,
        count if mask is None else mask,
        places,
        sums,
        signs.shape[-2],
        rows,
        blocks,
        values,
        run,
        HAS_MASK=mask is not None,
        WIDTH=width,
        COLUMNS=columns,
        TILE=_TILE,
    )
    _join[(numbers,)](
        places,
        sums,
        beta,
        decision,
        match,
        certainty,
        parts,
        dim,
        values,
        COLUMNS=columns,
        PARTS=triton.next_power_of_2(parts),
    )
    return decision, match, certainty


@triton.jit
def _count_ones(bits):
    # The compiler knows this sum of neighbours for the population count instruction.
    bits = bits - ((bits >> 1) & 0x55555555)
    bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
    bits = (bits + (bits >> 4)) & 0x0F0F0F0F
    return (bits * 0x01010101) >> 24


@triton.jit
def _scan(
    signs,
    words,
    successors,
    beta,
    counts,
    mask,
    places,
    sums,
    queries,
    rows,
    blocks,
    values,
    run,
    HAS_MASK: tl.constexpr,
    WIDTH: tl.constexpr,
    COLUMNS: tl.constexpr,
    TILE: tl.constexpr,
):
    number = tl.program_id(0).to(tl.int64)
    part = tl.program_id(1).to(tl.int64)
    parts = tl.num_programs(1)
    memory = number // queries
    count = tl.minimum(tl.load(counts + memory), rows)
    sharpness = tl.minimum(2.0 * tl.abs(tl.load(beta)), _SHARPEST)
    reach = (tl.log(tl.maximum(count, 1).to(tl.float32)) + _LOG_NEGLIGIBLE) / sharpness
    slack = tl.minimum(reach, 32.0 * WIDTH).to(tl.int32)

    lane = tl.arange(0, TILE).to(tl.int64)
    column = tl.arange(0, COLUMNS)
    nearest = tl.full((), _FAR, tl.int32)
    second = tl.full((), _FAR, tl.int32)
    match = tl.full((), -1, tl.int64)
    total = tl.zeros((), tl.float64)
    moment = tl.zeros((), tl.float64)
    added = tl.zeros((COLUMNS,), tl.float64)
    for first in range(part * run, tl.minimum((part + 1) * run, count), TILE):
        row = first + lane
        live = row < count
        place = (memory * blocks + row // 64) * (WIDTH * 64) + row % 64
        distance = tl.zeros((TILE,), tl.int32)
        for word in range(WIDTH):
            stored = tl.load(words + place + word * 64, mask=live, other=0)
            query = tl.load(signs + number * WIDTH + word)
            differing = (stored ^ query).to(tl.uint32, bitcast=True)
            distance += _count_ones(differing).to(tl.int32)
        if HAS_MASK:
            live &= tl.load(mask + number * rows + row, mask=live, other=0) != 0
        distance = tl.where(live, distance, _FAR)
        closest = tl.min(distance, 0)
        if closest < _FAR and closest <= tl.maximum(nearest + slack, second - 1):
            closest_row = tl.min(tl.where(distance == closest, row, _LAST), 0)
            rival = tl.min(tl.where(row == closest_row, _FAR, distance), 0)
            second = tl.minimum(tl.maximum(nearest, closest), tl.minimum(second, rival))
            match = tl.where(closest < nearest, closest_row, match)
            now = tl.minimum(nearest, closest)
            closer = (nearest - now).to(tl.float32)
            scale = tl.exp(-sharpness * closer).to(tl.float64)
            nearest = now
            above = (distance - nearest).to(tl.float32)
            weight = tl.where(live, tl.exp(-sharpness * above), 0.0)
            follower = tl.load(
                successors + (memory * rows + row)[:, None] * values + column[None, :],
                mask=(weight > 0)[:, None] & (column < values)[None, :],
                other=0.0,
            )
            moment = (moment + closer * total) * scale + tl.sum(weight * above, 0)
            total = total * scale + tl.sum(weight, 0)
            added = added * scale + tl.sum(weight[:, None] * follower, 0)

    slot = number * parts + part
    stride = tl.num_programs(0).to(tl.int64) * parts
    tl.store(places + slot, nearest.to(tl.int64))
    tl.store(places + stride + slot, second.to(tl.int64))
    tl.store(places + 2 * stride + slot, match)
    tl.store(sums + slot * (2 + COLUMNS), total)
    tl.store(sums + slot * (2 + COLUMNS) + 1, moment)
    tl.store(sums + slot * (2 + COLUMNS) + 2 + column, added)


@triton.jit
def _join(
    places,
    sums,
    beta,
    decision,
    match,
    certainty,
    parts,
    dim,
    values,
    COLUMNS: tl.constexpr,
    PARTS: tl.constexpr,
):
    number = tl.program_id(0).to(tl.int64)
    numbers = tl.num_programs(0).to(tl.int64)
    sharpness = tl.minimum(2.0 * tl.abs(tl.load(beta)), _SHARPEST)
    part = tl.arange(0, PARTS)
    column = tl.arange(0, COLUMNS)
    known = part < parts
    slot = number * parts + part
    nearest = tl.load(places + slot, mask=known, other=_FAR)
    second = tl.load(places + numbers * parts + slot, mask=known, other=_FAR)
    found = tl.load(places + 2 * numbers * parts + slot, mask=known, other=-1)

    closest = tl.min(nearest, 0)
    row = tl.min(tl.where((nearest == closest) & (found >= 0), found, _LAST), 0)
    rivals = tl.where(found == row, _FAR, nearest)
    runner_up = tl.minimum(tl.min(rivals, 0), tl.min(second, 0))
    # The parts' weights are relative to their own nearest row; of an empty part they are zero.
    farther = (nearest - closest).to(tl.float32)
    scale = tl.exp(-sharpness * farther).to(tl.float64)
    entry = slot * (2 + COLUMNS)
    totals = tl.load(sums + entry, mask=known, other=0.0)
    moments = tl.load(sums + entry + 1, mask=known, other=0.0)
    total = tl.sum(scale * totals, 0)
    moment = tl.sum(scale * (moments + farther * totals), 0)
    added = tl.load(sums + entry[:, None] + 2 + column[None, :], mask=known[:, None], other=0.0)
    added = tl.sum(scale[:, None] * added, 0)

    # NaN where no row takes part, as total is zero there, or beta is not a number.
    nothing = total * 0.0 / total
    nothing = tl.where(tl.load(beta) == tl.load(beta), nothing, float("nan"))
    sign = tl.where(tl.load(beta) < 0, -1.0, 1.0)
    margin = tl.where(runner_up == _FAR, float("inf"), (2 * (runner_up - closest)).to(tl.float64))
    tl.store(match + number, tl.where(closest == _FAR, -1, row))
    tl.store(certainty + number, sign * (dim - 2 * closest) + nothing)
    tl.store(certainty + numbers + number, margin + nothing)
    tl.store(certainty + 2 * numbers + number, tl.log(total) + sharpness * moment / total + nothing)
    tl.store(decision + number * values + column, added / total + nothing, mask=column < values)
