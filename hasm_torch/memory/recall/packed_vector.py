"""The three inner loops of the packed scan, written as vector code for LLVM.

They keep their sums in registers over loops whose length is known only at run time, which the
compiler does not arrive at by itself. LLVM splits the vectors where the machine's are shorter.

The compiled scan is cached by the time stamp of packed_kernel.py: touch that file after a change
here.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

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
_PART = 8  # words of a block between which it may be left
_CHAINS = 4  # rows added side by side, so that one addition need not wait for the last


@intrinsic
def block_distances(typing_context, block, query, width, reach, out):
    """Hamming distances of a packed query to the 64 associations of a block.

    A distance only grows from word to word, so a block is left as soon as all of its associations
    are out of reach.

    Args: addresses of the block (int32 (width, 64)) and of the query (int32 (width,)), the width,
    the largest distance that matters, and the address the distances go to (int32 (64,)).

    Returns: the smallest distance; if it is beyond the reach, a number that is too.
    """

    def emit(context, builder, signature, arguments):
        block, query, width, reach, out = arguments
        count_ones = _llvm(builder, "llvm.ctpop.v16i32", _WORDS, [_WORDS])
        smallest = _llvm(builder, "llvm.vector.reduce.smin.v16i32", _I32, [_WORDS])
        offsets = range(0, 4 * ROWS, 64)
        reach = _spread(builder, builder.trunc(reach, _I32), _WORDS)
        length = ir.Constant(_I64, _PART)
        parts = builder.sdiv(builder.add(width, ir.Constant(_I64, _PART - 1)), length)
        with _loop(builder, parts, [_same(_WORDS, 0)] * len(offsets)) as part_loop:
            part, before, after = part_loop.turn, part_loop.carried, part_loop.following
            first = _scaled(builder, part, _PART)
            left = builder.sub(width, first)
            words = builder.select(builder.icmp_signed("<", left, length), left, length)
            with _loop(builder, words, before) as word_loop:
                word = builder.add(first, word_loop.turn)
                bits = builder.load(_at(builder, query, _scaled(builder, word, 4), _I32))
                query_bits = _spread(builder, bits, _WORDS)
                line = builder.add(block, _scaled(builder, word, 4 * ROWS))
                for sums, offset in zip(word_loop.carried, offsets, strict=True):
                    stored = builder.load(_at(builder, line, offset, _WORDS), align=4)
                    ones = builder.call(count_ones, [builder.xor(stored, query_bits)])
                    word_loop.following.append(builder.add(sums, ones))
            after.extend(word_loop.following)
            in_reach = builder.icmp_signed("<=", _least(builder, after), reach)
            none = ir.Constant(ir.IntType(_WORDS.count), 0)
            part_loop.leave = builder.icmp_signed("==", builder.bitcast(in_reach, none.type), none)
        for total, offset in zip(after, offsets, strict=True):
            builder.store(total, _at(builder, out, offset, _WORDS), align=4)
        return builder.call(smallest, [_least(builder, after)])

    return types.int32(*[types.int64] * 5), emit


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
        with _loop(builder, rounds, [zeros] * _CHAINS) as loop:
            row = _scaled(builder, loop.turn, _CHAINS)
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
                added = builder.fadd(loop.carried[chain], product, flags=("contract",))
                loop.following.append(added)
                place = builder.add(place, pitch)
        added = loop.following[0]
        for part in loop.following[1:]:
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


def _least(builder: ir.IRBuilder, vectors: list[ir.Value]) -> ir.Value:
    """The smaller one in every lane."""
    least = vectors[0]
    for vector in vectors[1:]:
        least = builder.select(builder.icmp_signed("<", vector, least), vector, least)
    return least


@dataclass
class _Loop:
    """One turn of a loop: its number, the carried values, those for the next turn.

    Attributes:
        leave: Condition on which the turn is the last; None for no other than the number.
    """

    turn: ir.Value
    carried: list[ir.Value]
    following: list[ir.Value] = field(default_factory=list)
    leave: ir.Value | None = None


@contextmanager
def _loop(builder: ir.IRBuilder, times: ir.Value, initial: list[ir.Value]) -> Iterator[_Loop]:
    """A loop run at least once; its last turn's ``following`` are the results."""
    entry = builder.block
    body, end = builder.append_basic_block("body"), builder.append_basic_block("end")
    builder.branch(body)
    builder.position_at_end(body)
    loop = _Loop(builder.phi(_I64), [])
    loop.carried = [builder.phi(value.type) for value in initial]
    yield loop
    next_turn = builder.add(loop.turn, ir.Constant(_I64, 1))
    again = builder.icmp_signed("<", next_turn, times)
    if loop.leave is not None:
        again = builder.and_(again, builder.not_(loop.leave))
    last = builder.block  # another than ``body`` if a loop lies inside
    builder.cbranch(again, body, end)
    loop.turn.add_incoming(ir.Constant(_I64, 0), entry)
    loop.turn.add_incoming(next_turn, last)
    for phi, first, after in zip(loop.carried, initial, loop.following, strict=True):
        phi.add_incoming(first, entry)
        phi.add_incoming(after, last)
    builder.position_at_end(end)
