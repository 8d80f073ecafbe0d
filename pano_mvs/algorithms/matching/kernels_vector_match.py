"""Compiled to vector instructions: scalar products of descriptors of small whole numbers, and the nearest two of each.

A product of two 16-bit numbers costs half of what a float's does (PMADDWD multiplies pairs and adds them up), and one
of two bytes half of that again (VPDPBUSD, of bytes without and with a sign). All sums are exact, and the products are
compared in the registers.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import (
    REGISTER_BYTES,
    element_pointer,
    features_of_this_machine,
    load_unaligned,
)
from pano_mvs.core.kernels import kernel

LANES: Final = REGISTER_BYTES // 4
"""Number of products in one register."""

# Registers for the products of some rows with some columns; 32 registers of 64 bytes, 16 of the narrower kinds.
ROWS: Final = 6 if REGISTER_BYTES == 64 else 4
"""Number of rows that are multiplied at once; the number of rows must be a multiple."""
_REGISTERS: Final = 4 if REGISTER_BYTES == 64 else 2
COLUMNS: Final = _REGISTERS * LANES
"""Number of columns that are multiplied at once; the number of columns must be a multiple."""

# Panels whose packed descriptors stay in the first-level cache during one pass over the rows.
_PANELS_PER_BLOCK: Final = max(1, 128 // COLUMNS)
_PAIRS = {16: "llvm.x86.sse2.pmadd.wd", 32: "llvm.x86.avx2.pmadd.wd", 64: "llvm.x86.avx512.pmaddw.d.512"}
HAS_BYTES: Final = REGISTER_BYTES == 64 and "avx512vnni" in features_of_this_machine()
"""Whether descriptors may be bytes: the rows without a sign, the columns less 128, with a sign."""

_I16, _I32, _I64 = (ir.IntType(bits) for bits in (16, 32, 64))
_REGISTER = ir.VectorType(_I32, LANES)
_WORDS = ir.VectorType(_I16, 2 * LANES)


def _everywhere(builder: Any, value: Any) -> Any:
    first = builder.insert_element(ir.Constant(_REGISTER, ir.Undefined), value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, first, ir.Constant(_REGISTER, [0] * LANES))


def _larger(builder: Any, first: Any, second: Any) -> Any:
    return builder.select(builder.icmp_signed(">", first, second), first, second)


def _added(builder: Any, total: Any, row: Any, column: Any) -> Any:
    """Add the products of the components in two registers to a sum: pairs of words, or fours of bytes."""
    if row.type == _REGISTER:
        kind = ir.FunctionType(_REGISTER, [_REGISTER] * 3)
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.vpdpbusd.512"), [total, row, column]
        )
    kind = ir.FunctionType(_REGISTER, [_WORDS, _WORDS])
    pairs = cgutils.get_or_insert_function(builder.module, kind, _PAIRS[REGISTER_BYTES])
    return builder.add(total, builder.call(pairs, [row, column]))


def _products(builder: Any, steps: Any, row_places: list[Any], panel: Any, *, of: ir.VectorType) -> list[list[Any]]:
    """Emit the loop over registers of components, `of` a type; return ROWS × _REGISTERS registers of products."""
    zero = ir.Constant(_REGISTER, [0] * LANES)
    sums = [[cgutils.alloca_once_value(builder, zero) for _ in range(_REGISTERS)] for _ in range(ROWS)]
    with cgutils.for_range(builder, steps) as loop:
        columns = []
        for register in range(_REGISTERS):
            at = builder.add(builder.mul(loop.index, ir.Constant(_I64, _REGISTERS)), ir.Constant(_I64, register))
            columns.append(builder.bitcast(load_unaligned(builder, builder.gep(panel, [at])), of))
        for row, place in enumerate(row_places):
            few = load_unaligned(builder, builder.gep(place, [loop.index]))
            everywhere = builder.bitcast(_everywhere(builder, few), of)
            for register, column in enumerate(columns):
                total = _added(builder, builder.load(sums[row][register]), everywhere, column)
                builder.store(total, sums[row][register])
    return [[builder.load(total) for total in row] for row in sums]


def _take(builder: Any, values: list[Any], indices: list[Any], places: list[Any]) -> None:
    """Update one row's greatest value, second greatest value and column of the greatest."""
    best, second, nearest = (load_unaligned(builder, place) for place in places)
    for value, index in zip(values, indices, strict=True):
        second = _larger(builder, second, builder.select(builder.icmp_signed("<", best, value), best, value))
        nearest = builder.select(builder.icmp_signed(">", value, best), index, nearest)
        best = _larger(builder, best, value)
    for value, place in zip((best, second, nearest), places, strict=True):
        builder.store(value, place, align=1)


@intrinsic
def _match_tile(
    typingctx: Any,
    rows: Any,
    packed: Any,
    row_squares: Any,
    column_squares: Any,
    state: Any,
    column_best: Any,
    row: Any,
    panel: Any,
    steps: Any,
) -> Any:
    """Compare ROWS descriptors from `row` on with those of a panel of COLUMNS.

    Args:
        typingctx: the typing context of numba.
        rows: (n, 2 steps) int16, or (n, 4 steps) uint8.
        packed: (panels, steps, COLUMNS, 2) int16, or (panels, steps, COLUMNS, 4) int8.
        row_squares: (n,) int32 squared lengths; of bytes, less 256 Σa, as 2 a·b is 2 a·(b − 128) + 256 Σa.
        column_squares: (m,) int32.
        state: (n, 3, LANES) int32: greatest 2 a·b − |b|², the second greatest, the column of the greatest; updated.
        column_best: (m,) int32 greatest 2 a·b − |a|²; updated.
        row: position of the first row.
        panel: position of the panel.
        steps: number of pairs of words, or of fours of bytes, in a row.
    """
    place = types.uint64
    signature = types.void(rows, packed, row_squares, column_squares, state, column_best, place, place, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> None:
        def pointer(argument: int, position: Any, to: Any) -> Any:
            return element_pointer(context, builder, sig.args[argument], args[argument], position, to)

        def number(value: int) -> Any:
            return ir.Constant(_I64, value)

        first_row, panel, steps = args[6:]
        numbers = [builder.add(first_row, number(k)) for k in range(ROWS)]
        of_bytes = sig.args[0].dtype == types.uint8
        size = builder.mul(steps, number(4 if of_bytes else 2))
        row_places = [pointer(0, builder.mul(at, size), _I32) for at in numbers]
        packed_at = builder.mul(builder.mul(panel, size), number(COLUMNS))
        panel_place = pointer(1, packed_at, _REGISTER)
        products = _products(builder, steps, row_places, panel_place, of=_REGISTER if of_bytes else _WORDS)
        doubled = [[builder.shl(p, ir.Constant(_REGISTER, [1] * LANES)) for p in row] for row in products]
        first_column = builder.mul(panel, number(COLUMNS))
        columns = [builder.add(first_column, number(k * LANES)) for k in range(_REGISTERS)]
        lanes = ir.Constant(_REGISTER, list(range(LANES)))
        indices = [builder.add(_everywhere(builder, builder.trunc(at, _I32)), lanes) for at in columns]
        squares = [load_unaligned(builder, pointer(3, at, _REGISTER)) for at in columns]
        column_places = [pointer(5, at, _REGISTER) for at in columns]
        column_best = [load_unaligned(builder, where) for where in column_places]
        for at, values in zip(numbers, doubled, strict=True):
            base = builder.mul(at, number(3 * LANES))
            states = [pointer(4, builder.add(base, number(k * LANES)), _REGISTER) for k in range(3)]
            nearness = [builder.sub(value, square) for value, square in zip(values, squares, strict=True)]
            _take(builder, nearness, indices, states)
            own = _everywhere(builder, builder.load(pointer(2, at, _I32)))
            column_best = [
                _larger(builder, best, builder.sub(value, own)) for best, value in zip(column_best, values, strict=True)
            ]
        for best, where in zip(column_best, column_places, strict=True):
            builder.store(best, where, align=1)

    return signature, emit


@kernel
def compare_all(
    rows: NDArray[np.int16] | NDArray[np.uint8],
    packed: NDArray[np.int16] | NDArray[np.int8],
    row_squares: NDArray[np.int32],
    column_squares: NDArray[np.int32],
    state: NDArray[np.int32],
    column_best: NDArray[np.int32],
) -> None:
    """Compare all descriptors of two pictures; see `_match_tile` for the arrays."""
    steps = np.uint64(packed.shape[1])
    for first_panel in range(0, packed.shape[0], _PANELS_PER_BLOCK):
        last_panel = min(first_panel + _PANELS_PER_BLOCK, packed.shape[0])
        for row in range(0, rows.shape[0], ROWS):
            for panel in range(first_panel, last_panel):
                _match_tile(
                    rows,
                    packed,
                    row_squares,
                    column_squares,
                    state,
                    column_best,
                    np.uint64(row),
                    np.uint64(panel),
                    steps,
                )
