"""The three inner loops of the packed scan, written as vector code for LLVM.

They keep their sums in registers over loops whose length is known only at run time, which the
compiler does not arrive at by itself. LLVM splits the vectors where the machine's are shorter.

The compiled scan is cached by the time stamp of packed_kernel.py: touch that file after a change
here.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

ROWS = 64  # associations in a block
_I1, _I32, _I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
_F32, _F64 = ir.FloatType(), ir.DoubleType()
_WORDS, _FLOATS = ir.VectorType(_I32, 16), ir.VectorType(_F32, 16)
_VALUES = 8  # successor values added at once
_SUMS = ir.VectorType(_F64, _VALUES)
_SERIES = [math.log(2) ** power / math.factorial(power) for power in range(8)]  # of 2^x
_CHAINS = 4  # rows added side by side, so that one addition need not wait for the last


@intrinsic
def block_distances(typing_context, block, query, width, out):
    """Hamming distances of a packed query to the 64 associations of a block.

    Args: addresses of the block (int32 (width, 64)) and of the query (int32 (width,)), the width,
    and the address the distances go to (int32 (64,)).

    Returns: the smallest distance.
    """

    def emit(context, builder, signature, arguments):
        block, query, width, out = arguments
        count_ones = _llvm(builder, "llvm.ctpop.v16i32", _WORDS, [_WORDS])
        smallest = _llvm(builder, "llvm.vector.reduce.smin.v16i32", _I32, [_WORDS])
        offsets = range(0, 4 * ROWS, 64)
        with _loop(builder, width, [_same(_WORDS, 0)] * len(offsets)) as (word, sums, totals):
            bits = builder.load(_at(builder, query, _scaled(builder, word, 4), _I32))
            query_bits = _spread(builder, bits, _WORDS)
            line = builder.add(block, _scaled(builder, word, 4 * ROWS))
            for before, offset in zip(sums, offsets, strict=True):
                stored = builder.load(_at(builder, line, offset, _WORDS), align=4)
                ones = builder.call(count_ones, [builder.xor(stored, query_bits)])
                totals.append(builder.add(before, ones))
        nearest = totals[0]
        for total, offset in zip(totals, offsets, strict=True):
            builder.store(total, _at(builder, out, offset, _WORDS), align=4)
            nearest = builder.select(builder.icmp_signed("<", total, nearest), total, nearest)
        return builder.call(smallest, [nearest])

    return types.int32(types.int64, types.int64, types.int64, types.int64), emit


@intrinsic
def weigh_block(typing_context, distances, nearest, last, rate, weights):
    """Weights 2^(-rate·above) of the 64 associations of a block, above = distance - nearest.

    Args: address of the distances (int32 (64,)), the nearest of all, the number above it from
    which on rows weigh nothing, the rate, and the address the weights go to (float32 (64,)).

    Returns: the sum of the weights, and of the weights times above.
    """

    def emit(context, builder, signature, arguments):
        distances, nearest, last, rate, weights = arguments
        add_up = _llvm(builder, "llvm.vector.reduce.fadd.v16f32", _F32, [_F32, _FLOATS])
        nearest, last = (
            _spread(builder, builder.trunc(number, _I32), _WORDS) for number in (nearest, last)
        )
        fall = _spread(builder, builder.fneg(builder.fptrunc(rate, _F32)), _FLOATS)
        half, zeros = _same(_FLOATS, 0.5), _same(_FLOATS, 0.0)
        total = moment = zeros
        for offset in range(0, 4 * ROWS, 64):
            distance = builder.load(_at(builder, distances, offset, _WORDS), align=4)
            above = builder.sub(distance, nearest)
            heavy = builder.icmp_signed("<", above, last)
            above = builder.sitofp(builder.select(heavy, above, _same(_WORDS, 0)), _FLOATS)
            exponent = builder.fmul(above, fall)
            # 2^exponent: the whole part goes into the float's exponent bits, the rest, within
            # half of zero, into the power series of 2^x.
            whole = builder.fptosi(builder.fsub(exponent, half), _WORDS)
            rest = builder.fsub(exponent, builder.sitofp(whole, _FLOATS))
            power = _same(_FLOATS, _SERIES[-1])
            for coefficient in _SERIES[-2::-1]:
                power = builder.fadd(
                    builder.fmul(power, rest, flags=("contract",)),
                    _same(_FLOATS, coefficient),
                    flags=("contract",),
                )
            raised = builder.add(
                builder.bitcast(power, _WORDS), builder.shl(whole, _same(_WORDS, 23))
            )
            weight = builder.select(heavy, builder.bitcast(raised, _FLOATS), zeros)
            builder.store(weight, _at(builder, weights, offset, _FLOATS), align=4)
            total = builder.fadd(total, weight)
            moment = builder.fadd(moment, builder.fmul(weight, above))
        sums = [
            builder.fpext(
                builder.call(add_up, [ir.Constant(_F32, 0.0), part], fastmath=("reassoc",)), _F64
            )
            for part in (total, moment)
        ]
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(types.float64, 2)(
        types.int64, types.int64, types.int64, types.float64, types.int64
    ), emit


@intrinsic
def add_weighted_rows(typing_context, weights, successors, rows, stride, values, sums):
    """Adds up to eight columns of weighted successors: sums[v] += Σ_row weights[row] S[row, v].

    Args: addresses of the weights (float32 (rows,)) and of the first successor (float32), the
    number of rows (a positive multiple of four), values from one row to the next, columns to add
    (the rest is left alone), and the address of the sums (float64 (8,)).
    """

    def emit(context, builder, signature, arguments):
        weights, successors, rows, stride, values, sums = arguments
        floats, lanes = ir.VectorType(_F32, _VALUES), ir.VectorType(_I1, _VALUES)
        load = _llvm(
            builder,
            "llvm.masked.load.v8f32.p0",
            floats,
            [floats.as_pointer(), _I32, lanes, floats],
        )
        numbers = ir.Constant(ir.VectorType(_I64, _VALUES), list(range(_VALUES)))
        wanted = builder.icmp_signed("<", numbers, _spread(builder, values, numbers.type))
        zeros = _same(floats, 0.0)
        pitch = _scaled(builder, stride, 4)
        rounds = builder.sdiv(rows, ir.Constant(_I64, _CHAINS))
        with _loop(builder, rounds, [zeros] * _CHAINS) as (turn, before, after):
            row = _scaled(builder, turn, _CHAINS)
            weight_place = builder.add(weights, _scaled(builder, row, 4))
            place = builder.add(successors, builder.mul(row, pitch))
            for chain in range(_CHAINS):
                weight = builder.load(_at(builder, weight_place, 4 * chain, _F32))
                values = builder.call(
                    load, [_at(builder, place, 0, floats), ir.Constant(_I32, 4), wanted, zeros]
                )
                product = builder.fmul(
                    values, _spread(builder, weight, floats), flags=("contract",)
                )
                after.append(builder.fadd(before[chain], product, flags=("contract",)))
                place = builder.add(place, pitch)
        added = after[0]
        for part in after[1:]:
            added = builder.fadd(added, part)
        target = _at(builder, sums, 0, _SUMS)
        total = builder.fadd(builder.load(target, align=8), builder.fpext(added, _SUMS))
        builder.store(total, target, align=8)
        return context.get_dummy_value()

    return types.void(*[types.int64] * 6), emit


def _llvm(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Type]):
    return get_or_insert_function(builder.module, ir.FunctionType(result, arguments), name)


def _same(kind: ir.VectorType, number: float) -> ir.Constant:
    return ir.Constant(kind, [number] * kind.count)


def _scaled(builder: ir.IRBuilder, number: ir.Value, factor: int) -> ir.Value:
    return builder.mul(number, ir.Constant(_I64, factor))


def _at(builder: ir.IRBuilder, base: ir.Value, offset: ir.Value | int, kind: ir.Type) -> ir.Value:
    """Pointer to the value of a kind, ``offset`` bytes from an address."""
    if isinstance(offset, int):
        offset = ir.Constant(_I64, offset)
    return builder.inttoptr(builder.add(base, offset), kind.as_pointer())


def _spread(builder: ir.IRBuilder, number: ir.Value, kind: ir.VectorType) -> ir.Value:
    """A vector with the same number in every lane."""
    empty = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(empty, number, ir.Constant(_I32, 0))
    lanes = ir.VectorType(_I32, kind.count)
    return builder.shuffle_vector(first, empty, _same(lanes, 0))


@contextmanager
def _loop(
    builder: ir.IRBuilder, times: ir.Value, initial: list[ir.Value]
) -> Iterator[tuple[ir.Value, list[ir.Value], list[ir.Value]]]:
    """A loop run at least once: yields the turn, the carried values, a list for the next ones."""
    entry = builder.block
    body, end = builder.append_basic_block("body"), builder.append_basic_block("end")
    builder.branch(body)
    builder.position_at_end(body)
    number = builder.phi(_I64)
    carried = [builder.phi(value.type) for value in initial]
    following: list[ir.Value] = []
    yield number, carried, following
    next_number = builder.add(number, ir.Constant(_I64, 1))
    builder.cbranch(builder.icmp_signed("<", next_number, times), body, end)
    number.add_incoming(ir.Constant(_I64, 0), entry)
    number.add_incoming(next_number, body)
    for phi, first, after in zip(carried, initial, following, strict=True):
        phi.add_incoming(first, entry)
        phi.add_incoming(after, body)
    builder.position_at_end(end)
