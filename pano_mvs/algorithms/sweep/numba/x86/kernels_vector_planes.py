"""Compiled to vector instructions: paths along a row, where a register holds planes of one pixel and not pixels.

For that, costs are turned from plane after plane to pixel after pixel, and the sums back, in square blocks: one round
of interleaving the first half of the rows with the second moves one bit of the row's number to the column's.
"""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import element_pointer, load_unaligned
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector_path import LINES, everywhere, least_of

SIDE: Final = 16
"""Rows and columns of the blocks that are turned at once."""

_I8, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_WORDS, _BYTES = ir.VectorType(_I16, LINES), ir.VectorType(_I8, LINES)


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of a square block."""
    side = len(rows)
    masks = [
        ir.Constant(ir.VectorType(_I32, side), [half * side // 2 + k // 2 + (k % 2) * side for k in range(side)])
        for half in (0, 1)
    ]
    for _ in range(side.bit_length() - 1):
        pairs = [(rows[k], rows[k + side // 2]) for k in range(side // 2)]
        rows = [builder.shuffle_vector(*pair, mask) for pair in pairs for mask in masks]
    return rows


def _emit_turn(context: Any, builder: Any, sig: Any, args: Any, *, element: Any, sources: int) -> None:
    """Emit the turning of a block: of the sum of blocks that lie `args[2]` apart, if there are two of them."""
    kind = ir.VectorType(element, SIDE)
    source, start, apart, step, target, target_at, target_step = args

    def loaded(k: int, position: Any) -> Any:
        place = builder.add(position, builder.mul(step, ir.Constant(_I64, k)))
        return load_unaligned(builder, element_pointer(context, builder, sig.args[0], source, place, kind))

    rows = [loaded(k, start) for k in range(SIDE)]
    if sources == 2:
        rows = [builder.add(row, loaded(k, builder.add(start, apart))) for k, row in enumerate(rows)]
    for k, column in enumerate(_turned(builder, rows)):
        place = builder.add(target_at, builder.mul(target_step, ir.Constant(_I64, k)))
        pointer = element_pointer(context, builder, sig.args[4], target, place, kind)
        builder.store(column, pointer, align=1)


@intrinsic
def turn_bytes(
    typingctx: Any, source: Any, start: Any, apart: Any, step: Any, target: Any, target_at: Any, target_step: Any
) -> Any:
    """Write the columns of a block of SIDE rows as rows; `start` and `step` from row to row count elements, uint8."""
    place = types.uint64
    signature = types.void(source, place, place, place, target, place, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _emit_turn(context, builder, sig, args, element=_I8, sources=1)

    return signature, emit


@intrinsic
def turn_sums(
    typingctx: Any, source: Any, start: Any, apart: Any, step: Any, target: Any, target_at: Any, target_step: Any
) -> Any:
    """Do what `turn_bytes` does with the sum of two blocks, `apart` elements from each other, uint16."""
    place = types.uint64
    signature = types.void(source, place, place, place, target, place, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _emit_turn(context, builder, sig, args, element=_I16, sources=2)

    return signature, emit


def _emit_step_planes(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the instructions of `step_planes`; see there for the arguments."""
    costs, cost_at, paths, before_at, now_at, registers, barred, jump, floor, p1 = args

    def at(k: int, array: Any, position: Any, kind: Any = _WORDS) -> Any:
        return element_pointer(context, builder, sig.args[k], array, position, kind)

    def shifted(first: Any, second: Any, start: int) -> Any:
        mask = ir.Constant(ir.VectorType(_I32, LINES), [start + k for k in range(LINES)])
        return builder.shuffle_vector(first, second, mask)

    outside = ir.Constant(_WORDS, [60000] * LINES)
    floors, jumps, steps = (everywhere(builder, value) for value in (floor, jump, p1))
    lowest = cgutils.alloca_once_value(builder, outside)
    before = cgutils.alloca_once_value(builder, outside)
    here = cgutils.alloca_once_value(builder, load_unaligned(builder, at(2, paths, before_at)))
    with cgutils.for_range(builder, registers) as loop:
        plane = builder.mul(loop.index, ir.Constant(_I64, LINES))
        following = builder.add(plane, ir.Constant(_I64, LINES))
        stay = builder.load(here)
        # The row after the last one is there, but not its planes.
        after = load_unaligned(builder, at(2, paths, builder.add(before_at, following)))
        is_last = builder.icmp_unsigned("==", builder.add(loop.index, ir.Constant(_I64, 1)), registers)
        after = builder.select(is_last, outside, after)
        down, up = shifted(builder.load(before), stay, LINES - 1), shifted(stay, after, 1)
        near = builder.add(least_of(builder, down, up), steps)
        near = least_of(builder, stay, least_of(builder, near, jumps))
        cost = builder.zext(load_unaligned(builder, at(0, costs, builder.add(cost_at, plane), _BYTES)), _WORDS)
        value = builder.add(builder.sub(near, floors), cost)
        bar = load_unaligned(builder, at(6, barred, plane))
        value = builder.select(builder.icmp_unsigned(">", value, bar), value, bar)
        builder.store(value, at(2, paths, builder.add(now_at, plane)), align=1)
        builder.store(least_of(builder, value, builder.load(lowest)), lowest)
        builder.store(stay, before)
        builder.store(after, here)
    kind = ir.FunctionType(_I16, [_WORDS])
    reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.umin.v{LINES}i16")
    return builder.call(reduce, [builder.load(lowest)])


@intrinsic
def step_planes(
    typingctx: Any,
    costs: Any,
    cost_at: Any,
    paths: Any,
    before_at: Any,
    now_at: Any,
    registers: Any,
    barred: Any,
    jump: Any,
    floor: Any,
    p1: Any,
) -> Any:
    """Advance a path along a row by one pixel and return the least of its costs.

    Args:
        typingctx: numba's.
        costs: uint8; positions are uint64 and count elements.
        cost_at: where the pixel's first plane is.
        paths: uint16; a register more than the last pixel's can be read.
        before_at: where the first plane of the pixel before is.
        now_at: where that of this pixel is, which is written.
        registers: uint64, LINES planes in each.
        barred: uint16 for each plane: 0, or where there is none the least cost that it may get.
        jump: uint16, the least cost of the pixel before with P2.
        floor: uint16, the least cost of the pixel before.
        p1: uint16.
    """
    place, word = types.uint64, types.uint16
    signature = word(costs, place, paths, place, place, place, barred, word, word, word)
    return signature, _emit_step_planes
