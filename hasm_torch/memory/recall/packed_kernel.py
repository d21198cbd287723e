"""The scan of a packed memory on a CPU, compiled on first use by numba's LLVM.

A block holds 64 associations, word by word: ``words[block, w, row]``. XOR with the query's word w
and a population count give 64 partial Hamming distances at once, with no sum across lanes. The
softmax is folded into the scan. With h the Hamming distance, the inner product of two ±1 codes is
s = D - 2h, so the weight relative to the best match is exp(-2 beta (h - h_min)).

The smallest distance seen so far bounds what the rest may weigh: a row farther than ``slack`` above
it weighs less than NEGLIGIBLE / K, all such rows together less than NEGLIGIBLE of the whole, so a
block whose nearest row lies beyond is left at the word that shows it, and no successor is read.

Every function takes one pointer, to a job record (JOB_FIELDS), so that a team of threads can run
it; the threads take the tasks (runs of blocks) from a shared counter.
"""

import math

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, from_dtype, njit, types
from numba.extending import intrinsic

from hasm_torch.memory.recall.packed_vector import (
    ROWS,
    add_weighted_rows,
    block_distances,
    weigh_block,
)

NEGLIGIBLE = 2.0**-40  # weight that may be dropped, relative to the whole
FAR = 1 << 29  # distance of a row that takes no part

_SHARPEST = 1e4  # beyond it only the nearest rows weigh, in float64
_CACHED_BYTES = 16_384  # words kept in the first-level cache while the queries go over them
_TASK_BLOCKS = 64  # at most so many blocks a task

# Record handed to the kernels. Addresses are integers; a missing mask has address 0.
JOB_FIELDS = [
    ("next_task", "i8"),  # shared counter: tasks handed out
    ("next_slot", "i8"),  # shared counter: threads that joined
    ("query", "i8"),  # float32 (memories, queries, dim): the sign counts
    ("words", "i8"),  # int32 (memories, blocks, width, 64)
    ("successors", "i8"),  # float32 (memories, rows, values)
    ("counts", "i8"),  # int64 (memories,): live rows
    ("mask", "i8"),  # bool (memories, queries, rows), or 0
    ("decision", "i8"),  # out, float32 (memories, queries, values)
    ("match", "i8"),  # out, int64 (memories, queries)
    ("certainty", "i8"),  # out, float32 (3, memories, queries): score, margin, entropy
    ("signs", "i8"),  # scratch, int32 (memories, queries, width): the packed queries
    ("states", "i8"),  # scratch, float64 (threads, memories * queries, 5 + values)
    ("buffers", "i8"),  # scratch, 4 bytes (threads, 128): 64 distances and 64 weights
    ("memories", "i8"),
    ("queries", "i8"),
    ("dim", "i8"),
    ("values", "i8"),
    ("rows", "i8"),
    ("blocks", "i8"),
    ("threads", "i8"),
    ("slack", "i8"),  # set by begin: distances above the nearest that still weigh
    ("tasks", "i8"),  # set by begin
    ("run", "i8"),  # set by begin: blocks a task
    ("beta", "f8"),
    ("sharpness", "f8"),  # set by begin: weight exp(-sharpness * distance)
]
BUFFER_ENTRIES = ROWS  # of one thread, in float64
# Nearest distance, its row, second distance, sum of weights, sum of weights times the distance
# above the nearest; then the weighted successors.
_STATE = 5
_JOB = types.CPointer(from_dtype(np.dtype(JOB_FIELDS)))
_I64 = ir.IntType(64)


def _pointer_to(element):
    """Intrinsic that turns an integer address into a typed pointer."""

    @intrinsic
    def pointer(typing_context, address):
        def emit(context, builder, signature, arguments):
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(element)(types.int64), emit

    return pointer


_int32s, _int64s = _pointer_to(types.int32), _pointer_to(types.int64)
_float32s, _float64s = _pointer_to(types.float32), _pointer_to(types.float64)
_bytes = _pointer_to(types.uint8)


@intrinsic
def _take(typing_context, job, field):
    """Adds one to the job's shared counter number ``field`` and returns what it was."""

    def emit(context, builder, signature, arguments):
        record = builder.ptrtoint(arguments[0], _I64)
        address = builder.add(record, builder.mul(arguments[1], ir.Constant(_I64, 8)))
        counter = builder.inttoptr(address, _I64.as_pointer())
        return builder.atomic_rmw("add", counter, ir.Constant(_I64, 1), "monotonic")

    return types.int64(_JOB, types.int64), emit


def state_entries(values: int) -> int:
    """Entries of one query's state; values are added eight at a time."""
    return _STATE + (values + 7) // 8 * 8


_state_entries = njit(cache=True)(state_entries)


@cfunc(types.void(_JOB), cache=True)
def begin(job_pointer):
    """Packs the queries, bounds what weighs, clears the states, cuts the memory into tasks."""
    job = carray(job_pointer, 1)[0]
    width = (job.dim + 31) // 32
    queries = job.memories * job.queries

    source, signs = _float32s(job.query), _int32s(job.signs)
    for query in range(queries):
        for word in range(width):
            bits = np.uint32(0)
            for bit in range(min(32, job.dim - 32 * word)):
                # With a negative beta the farthest row counts; the complement makes it nearest.
                positive = source[query * job.dim + 32 * word + bit] >= 0
                bits |= np.uint32(positive != (job.beta < 0)) << np.uint32(bit)
            signs[query * width + word] = np.int32(bits)

    counts = _int64s(job.counts)
    live = 0
    for memory in range(job.memories):
        live = max(live, min(counts[memory], job.rows))
    job.sharpness = min(2.0 * abs(job.beta), _SHARPEST)
    # exp(-sharpness * (slack + 1)) <= NEGLIGIBLE / K
    reach = math.log(max(live, 1) / NEGLIGIBLE)
    job.slack = int(min(reach / job.sharpness, job.dim)) if job.sharpness > 0 else job.dim
    states = _float64s(job.states)
    size = _state_entries(job.values)
    for entry in range(job.threads * queries * size):
        states[entry] = 0.0
    for state in range(job.threads * queries):
        states[state * size] = FAR
        states[state * size + 1] = -1
        states[state * size + 2] = FAR

    blocks = (live + ROWS - 1) // ROWS
    job.run = max(1, min(_TASK_BLOCKS, blocks // (8 * job.threads)))
    job.tasks = job.memories * ((blocks + job.run - 1) // job.run)


@njit(cache=True)
def _absorb(job, memory, first_row, count, closest, state_address, distances_address):
    """Adds a block whose distances are known to the running sums of a query."""
    state, distances = _float64s(state_address), _int32s(distances_address)
    if closest < state[2]:
        before, nearest, second = int(state[0]), int(state[0]), int(state[2])
        for row in range(ROWS):
            distance = distances[row]
            if distance < nearest:
                second, nearest = nearest, distance
                state[1] = first_row + row
            elif distance < second:
                second = distance
        state[0], state[2] = nearest, second
        scale = math.exp(-job.sharpness * (before - nearest))
        state[4] = (state[4] + (before - nearest) * state[3]) * scale
        state[3] *= scale
        for value in range(job.values):
            state[_STATE + value] *= scale

    weights_address = distances_address + 4 * ROWS
    added: tuple[float, float] = weigh_block(  # type: ignore[call-arg]
        distances_address,
        int(state[0]),
        job.slack + 1,
        job.sharpness / math.log(2.0),
        weights_address,
    )
    state[3] += added[0]
    state[4] += added[1]

    rows = min(ROWS, count - first_row)
    fours = rows // 4 * 4
    first = (memory * job.rows + first_row) * job.values
    if fours > 0:
        for value in range(0, job.values, 8):
            add_weighted_rows(
                weights_address,
                job.successors + 4 * (first + value),
                fours,
                job.values,
                job.values - value,
                state_address + 8 * (_STATE + value),
            )
    weights, successors = _float32s(weights_address), _float32s(job.successors)
    for row in range(fours, rows):
        for value in range(job.values):
            state[_STATE + value] += weights[row] * successors[first + row * job.values + value]


@njit(cache=True)
def _keep_live(job, memory, query, first_row, count, distances):
    """Puts rows that take no part out of reach; returns the smallest distance left."""
    mask = _bytes(job.mask)
    offset = (memory * job.queries + query) * job.rows + first_row
    nearest = FAR
    for row in range(ROWS):
        if first_row + row >= count or (job.mask != 0 and mask[offset + row] == 0):
            distances[row] = FAR
        nearest = min(nearest, distances[row])
    return nearest


@cfunc(types.void(_JOB), cache=True)
def scan(job_pointer):
    """One thread's part: tasks until none is left, with a state of its own for every query."""
    job = carray(job_pointer, 1)[0]
    slot: int = _take(job_pointer, 1)  # type: ignore[call-arg]
    width = (job.dim + 31) // 32
    size = _state_entries(job.values)
    own_states = job.states + 8 * slot * job.memories * job.queries * size
    buffer = job.buffers + 8 * slot * BUFFER_ENTRIES
    distances = _int32s(buffer)
    counts = _int64s(job.counts)
    group = max(1, _CACHED_BYTES // (4 * ROWS * width))
    tasks_each = job.tasks // job.memories
    while True:
        task = _take(job_pointer, 0)
        if task >= job.tasks:
            break
        memory = task // tasks_each
        count = min(counts[memory], job.rows)
        begin_block = (task % tasks_each) * job.run
        end_block = min(begin_block + job.run, (count + ROWS - 1) // ROWS)
        for first in range(begin_block, end_block, group):
            for query in range(job.queries):
                number = memory * job.queries + query
                state_address = own_states + 8 * number * size
                state = _float64s(state_address)
                reach = max(int(state[0]) + job.slack, int(state[2]) - 1)
                signs = job.signs + 4 * number * width
                for block in range(first, min(first + group, end_block)):
                    place = job.words + 4 * ROWS * width * (memory * job.blocks + block)
                    nearest = block_distances(place, signs, width, reach, buffer)
                    if nearest <= reach:
                        first_row = block * ROWS
                        if job.mask != 0 or first_row + ROWS > count:
                            nearest = _keep_live(job, memory, query, first_row, count, distances)
                        if nearest <= reach and nearest < FAR:
                            _absorb(job, memory, first_row, count, nearest, state_address, buffer)
                            reach = max(int(state[0]) + job.slack, int(state[2]) - 1)


@cfunc(types.void(_JOB), cache=True)
def finish(job_pointer):
    """Joins the threads' states and writes the results."""
    job = carray(job_pointer, 1)[0]
    size = _state_entries(job.values)
    queries = job.memories * job.queries
    states = _float64s(job.states)
    decision, match = _float32s(job.decision), _int64s(job.match)
    score = _float32s(job.certainty)
    margin = _float32s(job.certainty + 4 * queries)
    entropy = _float32s(job.certainty + 8 * queries)
    for query in range(queries):
        nearest, second, row = FAR, FAR, -1
        for thread in range(job.threads):
            state = (thread * queries + query) * size
            distance = int(states[state])
            if distance < nearest:
                nearest, second, row = distance, min(nearest, second), int(states[state + 1])
            elif distance < FAR:
                if distance == nearest:
                    row = min(row, int(states[state + 1]))
                second = min(second, distance)
            second = min(second, int(states[state + 2]))
        if nearest == FAR:
            match[query] = -1
            score[query] = margin[query] = entropy[query] = math.nan
            for value in range(job.values):
                decision[query * job.values + value] = math.nan
            continue

        total, moment = 0.0, 0.0
        sums = (query * size) + _STATE  # the first thread's sums gather those of the others
        for thread in range(job.threads):
            state = (thread * queries + query) * size
            farther = states[state] - nearest
            scale = math.exp(-job.sharpness * farther)
            total += scale * states[state + 3]
            moment += scale * (states[state + 4] + farther * states[state + 3])
            for value in range(job.values):
                gathered = states[sums + value] if thread > 0 else 0.0
                states[sums + value] = gathered + scale * states[state + _STATE + value]
        for value in range(job.values):
            decision[query * job.values + value] = states[sums + value] / total
        match[query] = row
        score[query] = (job.dim - 2 * nearest) * (-1 if job.beta < 0 else 1)
        margin[query] = 2 * (second - nearest) if second < FAR else math.inf
        entropy[query] = math.log(total) + job.sharpness * moment / total
