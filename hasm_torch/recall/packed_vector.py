"""The two inner loops of the packed scan, written as vector code for LLVM.

Both keep their sums in registers over a loop whose length is known only at run time, which the
compiler does not arrive at by itself. LLVM splits the vectors where the machine's are shorter.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

ROWS = 64  # associations in a block
_I1, _I32, _I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
_F32, _F64 = ir.FloatType(), ir.DoubleType()
_WORDS = ir.VectorType(_I32, 16)
_VALUES = 8  # successor values added at once
_SUMS = ir.VectorType(_F64, _VALUES)
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
        zeros = ir.Constant(_WORDS, [0] * 16)
        with _loop(builder, width, [zeros] * len(offsets)) as (word, sums, totals):
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
def add_weighted_rows(typing_context, weights, successors, rows, stride, values, sums):
    """Adds up to eight columns of weighted successors: sums[v] += Σ_row weights[row] S[row, v].

    Args: addresses of the weights (float64 (rows,)) and of the first successor (float32), the
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
        zeros = ir.Constant(floats, [0.0] * _VALUES)
        clear = [ir.Constant(_SUMS, [0.0] * _VALUES)] * _CHAINS
        pitch = _scaled(builder, stride, 4)
        rounds = builder.sdiv(rows, ir.Constant(_I64, _CHAINS))
        with _loop(builder, rounds, clear) as (turn, before, after):
            row = _scaled(builder, turn, _CHAINS)
            weight_place = builder.add(weights, _scaled(builder, row, 8))
            place = builder.add(successors, builder.mul(row, pitch))
            for chain in range(_CHAINS):
                weight = builder.load(_at(builder, weight_place, 8 * chain, _F64))
                values = builder.call(
                    load, [_at(builder, place, 0, floats), ir.Constant(_I32, 4), wanted, zeros]
                )
                product = builder.fmul(
                    builder.fpext(values, _SUMS),
                    _spread(builder, weight, _SUMS),
                    flags=("contract",),
                )
                after.append(builder.fadd(before[chain], product, flags=("contract",)))
                place = builder.add(place, pitch)
        place = _at(builder, sums, 0, _SUMS)
        total = builder.load(place, align=8)
        for part in after:
            total = builder.fadd(total, part)
        builder.store(total, place, align=8)
        return context.get_dummy_value()

    return types.void(*[types.int64] * 6), emit


def _llvm(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Type]):
    return get_or_insert_function(builder.module, ir.FunctionType(result, arguments), name)


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
    lanes = ir.Constant(ir.VectorType(_I32, kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, empty, lanes)


@contextmanager
def _loop(
    builder: ir.IRBuilder, times: ir.Value, initial: list[ir.Value]
) -> Iterator[tuple[ir.Value, list[ir.Value], list[ir.Value]]]:
    """A loop run at least once; yields its number, the carried values, a list for their successors."""
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
