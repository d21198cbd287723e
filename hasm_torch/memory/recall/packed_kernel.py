"""The scan of a packed memory on a CPU, compiled on first use by numba.

A block holds 64 associations, word by word: ``words[block, w, row]``. XOR with the query's word w
and a population count give 64 partial Hamming distances at once, with no sum across lanes. With h
the distance, the inner product of two ±1 codes is s = D - 2h, so that a row's weight depends on h
and on how many rows lie at each distance. Hence three passes:

    compare   counts the rows at each distance from each query
    weigh     makes of the counts the weight of a row at each distance
    add       adds the successors with their weights

The smallest distance seen so far bounds what the rest may weigh. Farther than ``slack`` above it, a
row weighs nothing under sparsemax and entmax15, and under softmax less than NEGLIGIBLE / K, all
such rows together less than NEGLIGIBLE of the whole. A block whose nearest row lies beyond is left
at the word that shows it, and its successors are not read.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic

from hasm_torch.memory.recall.packed_weigh import FAR, SOFTMAX, weigh

ROWS = 64  # associations in a block
NEGLIGIBLE = 2.0**-40  # weight that may be dropped, relative to the whole

_PART = 8  # words of a block between which it may be left
_CACHED_BYTES = 16_384  # words kept in the first-level cache while the queries go over them


class _Job(NamedTuple):
    """What the passes share: one memory, Q queries, P parts of the memory."""

    words: Any  # uint32 (blocks, width, 64)
    successors: Any  # float32 (rows, values)
    count: Any  # rows filled
    mask: Any  # bool (Q, rows), or (0, rows) for none
    beta: Any
    kind: Any
    top_k: Any  # 0 for all
    slack: Any  # distances above the least that may weigh
    signs: Any  # uint32 (Q, width): packed queries, complemented where β is negative
    near: Any  # int32 (Q, rows, 2): rows within reach and their distances, a list in each part
    number: Any  # int64 (P, Q): length of the list
    found: Any  # int64 (P, Q, 3): least distance, second least, row of the least
    counts: Any  # int64 (P, Q, D + 1): rows at each distance
    table: Any  # float64 (Q, D + 1): weight of a row at each distance
    last: Any  # int64 (Q,): largest distance that weighs
    sums: Any  # float64 (P, Q, values): weighted successors
    decision: Any  # out, float32 (Q, values); this and what follows without queries if not asked
    match: Any  # out, int64 (Q,)
    certainty: Any  # out, float32 (3, Q): score, margin, entropy
    weights: Any  # out, float32 (Q, rows)


@intrinsic
def _pointer(typing_context, address):
    """An address as a pointer."""

    def emit(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), emit


@intrinsic
def _count_ones(typing_context, bits):
    """Number of ones in a uint32."""

    def emit(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint32(types.uint32), emit


@intrinsic
def _lowest(typing_context, bits):
    """Number of the lowest one in a uint64 other than zero."""

    def emit(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), emit


@intrinsic
def _at_most(typing_context, distances, reach):
    """Which of 64 int32 are at most ``reach``: a bit each, the first one lowest.

    The compiler does not arrive at a comparison of vectors whose outcome is a number by itself.
    """
    lane = ir.IntType(32)
    lanes = ir.VectorType(lane, ROWS)

    def emit(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        values = builder.load(builder.bitcast(array.data, lanes.as_pointer()), align=4)
        empty = ir.Constant(lanes, ir.Undefined)
        one = builder.insert_element(empty, builder.trunc(arguments[1], lane), lane(0))
        limits = builder.shuffle_vector(one, empty, ir.Constant(lanes, [0] * ROWS))
        return builder.bitcast(builder.icmp_signed("<=", values, limits), ir.IntType(64))

    return types.uint64(distances, types.int64), emit


@njit(nogil=True, cache=True)
def prepare(parts, sizes, addresses, options, share):
    """Packs the queries, bounds what may weigh, and makes room for what the passes find."""
    memories, queries, dim, blocks, width, rows, values = sizes
    (beta, kind, top_k), (memory, first, end) = options, share
    query, words, successors, counts, mask, decision, match, certainty, weights = addresses
    asked, batch = end - first, (memories, queries)
    codes = carray(_pointer(query), (*batch, dim), np.float32)  # type: ignore[call-arg]
    codes = codes[memory, first:end]
    count = min(carray(_pointer(counts), memories, np.int64)[memory], rows)
    signs = np.zeros((asked, width), np.uint32)
    for number in range(asked):
        for word in range(width):
            bits = np.uint32(0)
            for bit in range(min(32, dim - 32 * word)):
                # With a negative β the farthest row counts; the complement makes it the nearest.
                positive = codes[number, 32 * word + bit] >= 0
                bits |= np.uint32(positive != (beta < 0)) << np.uint32(bit)
            signs[number, word] = bits

    reach = float(dim)
    if beta != 0 and kind == SOFTMAX:  # exp(-2 |β| (slack + 1)) <= NEGLIGIBLE / K
        reach = math.log(max(count, 1) / NEGLIGIBLE) / (2 * abs(beta))
    elif beta != 0 and kind > SOFTMAX:  # x = -2 |β| slack / p >= -1
        reach = kind / (2 * abs(beta))
    masked, decided = (memories, queries * (mask != 0)), (memories, queries * (decision != 0))
    judged, weighed = (memories, queries * (match != 0)), (memories, queries * (weights != 0))
    return _Job(
        carray(_pointer(words), (memories, blocks, width, ROWS), np.uint32)[memory],
        carray(_pointer(successors), (memories, rows, values), np.float32)[memory],
        count,
        carray(_pointer(mask), (*masked, rows), np.bool_)[memory, first:end],
        beta,
        kind,
        top_k,
        int(min(reach, dim)),
        signs,
        np.empty((asked, blocks * ROWS, 2), np.int32),
        np.zeros((parts, asked), np.int64),
        np.full((parts, asked, 3), FAR),
        np.zeros((parts, asked, dim + 1), np.int64),
        np.empty((asked, dim + 1)),
        np.full(asked, -1),
        np.zeros((parts, asked, values if decision else 0)),
        carray(_pointer(decision), (*decided, values), np.float32)[memory, first:end],
        carray(_pointer(match), judged, np.int64)[memory, first:end],
        carray(_pointer(certainty), (3, *judged), np.float32)[:, memory, first:end],
        carray(_pointer(weights), (*weighed, rows), np.float32)[memory, first:end],
    )


@njit(nogil=True, cache=True)
def recall(sizes, addresses, options, share):
    """Recalls for some queries of one memory.

    Args: sizes and addresses of what ``scan_cpu`` has; β, the kind of the interaction, how many
    matches weigh, 0 for all; the memory, the first query and the one after the last.
    """
    job = prepare(1, sizes, addresses, options, share)
    compare(job, 0)
    weigh(job)
    add(job, 0)
    join(job)


@njit(nogil=True, cache=True)
def _blocks_of(job, part):
    """First block of a part and the one after its last."""
    blocks, parts = (job.count + ROWS - 1) // ROWS, len(job.found)
    return blocks * part // parts, blocks * (part + 1) // parts


@njit(nogil=True, cache=True)
def compare(job, part):
    """Lists the rows of a part that may weigh, and counts them at each distance."""
    begin, end = _blocks_of(job, part)
    queries, width = job.signs.shape
    dim = job.table.shape[1] - 1
    words, masked, certain = job.words, len(job.mask) > 0, len(job.match) > 0
    distances = np.empty(ROWS, np.int32)
    group = max(1, _CACHED_BYTES // (4 * ROWS * width))
    for first in range(begin, end, group):
        for query in range(queries):
            signs, found = job.signs[query], job.found[part, query]
            least, second, match = found
            near, counts = job.near[query, begin * ROWS :], job.counts[part, query]
            number = job.number[part, query]
            for block in range(first, min(first + group, end)):
                reach = min(least + job.slack, dim)
                if certain:
                    reach = min(max(reach, second - 1), dim)
                rows = _within_reach(words[block], signs, reach, distances)
                while rows != 0:
                    place = np.int64(_lowest(rows))  # type: ignore[call-arg]
                    rows &= rows - np.uint64(1)
                    row, distance = block * ROWS + place, distances[place]
                    if row >= job.count or (masked and not job.mask[query, row]):
                        continue
                    counts[distance] += 1
                    near[number, 0], near[number, 1] = row, distance
                    number += 1
                    if distance < second:
                        second = max(distance, least)
                        if distance < least:
                            least, match = distance, row
            found[0], found[1], found[2] = least, second, match
            job.number[part, query] = number


@njit(nogil=True, cache=True)
def _within_reach(words, signs, reach, distances):
    """Distances of a query to the rows of a block, (64,); returns which are in reach, a bit each.

    A distance only grows from word to word, so a block is left when all its rows are out of reach.
    """
    distances[:] = 0
    width = len(signs)
    step = _PART if reach < 32 * (width - 1) else width
    rows = np.uint64(0)
    for first in range(0, width, step):
        for word in range(first, min(first + step, width)):
            bits = signs[word]
            for row in range(ROWS):
                distances[row] += _count_ones(words[word, row] ^ bits)  # type: ignore[call-arg]
        rows = _at_most(distances, reach)  # type: ignore[call-arg]
        if rows == 0:
            break
    return rows


@njit(nogil=True, cache=True)
def add(job, part):
    """Adds the successors of the rows of a part with their weights."""
    begin, _ = _blocks_of(job, part)
    successors, weighed = job.successors, len(job.weights) > 0
    for query in range(len(job.signs)):
        last, table, sums = job.last[query], job.table[query], job.sums[part, query]
        near = job.near[query, begin * ROWS :]
        for place in range(job.number[part, query]):
            row, distance = near[place, 0], near[place, 1]
            if distance > last or table[distance] == 0.0:
                continue
            weight = table[distance]
            if weighed:
                job.weights[query, row] = weight
            for value in range(len(sums)):
                sums[value] += weight * successors[row, value]


@njit(nogil=True, cache=True)
def join(job):
    """Adds up what the parts added, NaN where nothing takes part in weights that sum to one."""
    for query in range(len(job.decision)):
        nothing = job.last[query] < 0 and job.kind >= SOFTMAX
        for value in range(job.decision.shape[1]):
            total = math.nan if nothing else 0.0
            for part in range(len(job.sums)):
                total += job.sums[part, query, value]
            job.decision[query, value] = total
