"""Compiled to vector instructions: steps of the paths of semi-global matching.

Across rows, a register holds neighbouring paths, and the costs of the planes before and after stay in registers; a loop
cannot be proved free of aliasing without more checks than a strip has work. Paths of several directions that come to
the same pixels are advanced together, so that costs and sums are read once.

Along a row, a register holds planes of one pixel. For that, costs are turned from plane after plane to pixel after
pixel, and the sums back, in square blocks: one round of interleaving the first half of the rows with the second moves
one bit of the row's number to the column's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import (
    I8,
    I16,
    I32,
    I64,
    REGISTER_BYTES,
    element_pointer,
    load_unaligned,
)

LINES: Final = REGISTER_BYTES // 2
"""How many paths of each direction one call advances."""

_WORDS, _BYTES = ir.VectorType(I16, LINES), ir.VectorType(I8, LINES)
_OUTSIDE = ir.Constant(_WORDS, [60000] * LINES)


def everywhere(builder: Any, value: Any) -> Any:
    """Return a register filled with one value."""
    first = builder.insert_element(ir.Constant(_WORDS, ir.Undefined), value, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(I32, LINES), [0] * LINES))


def least_of(builder: Any, first: Any, second: Any) -> Any:
    """Return the lesser of each pair of numbers."""
    return builder.select(builder.icmp_unsigned("<", first, second), first, second)


def _inside(builder: Any, first: Any, last: Any) -> Any:
    """Return which of the lines are from `first` to before `last`."""
    lines = ir.Constant(_WORDS, list(range(LINES)))
    bounds = [everywhere(builder, builder.trunc(bound, I16)) for bound in (first, last)]
    return builder.and_(builder.icmp_unsigned(">=", lines, bounds[0]), builder.icmp_unsigned("<", lines, bounds[1]))


class _Paths:
    """The paths of one direction: what they carry from plane to plane, in registers."""

    def __init__(self, builder: Any, penalties: Any, least: Any, paths_in: Callable[[Any], Any], p1: Any) -> None:
        """Load what does not change; `paths_in` returns where the paths' costs in a plane are."""
        self.builder, self.p1, self.least, self.paths_in = builder, p1, least, paths_in
        self.floor = load_unaligned(builder, least)
        self.jump = builder.add(self.floor, load_unaligned(builder, penalties))
        self.before, self.here, self.lowest = (cgutils.alloca_once(builder, _WORDS) for _ in range(3))

    def begin(self) -> None:
        """Start with the first plane."""
        self.builder.store(_OUTSIDE, self.before)
        self.builder.store(_OUTSIDE, self.lowest)
        self.builder.store(load_unaligned(self.builder, self.paths_in(ir.Constant(I64, 0))), self.here)

    def step(self, plane: Any, cost: Any, inside: Any) -> Any:
        """Write and return the costs of a plane; where not `inside`, if that is given, nothing is written."""
        builder = self.builder
        stay = builder.load(self.here)
        after = load_unaligned(builder, self.paths_in(builder.add(plane, ir.Constant(I64, 1))))
        near = builder.add(least_of(builder, builder.load(self.before), after), self.p1)
        near = least_of(builder, stay, least_of(builder, near, self.jump))
        value = builder.add(builder.sub(near, self.floor), cost)
        builder.store(least_of(builder, value, builder.load(self.lowest)), self.lowest)
        builder.store(stay, self.before)
        builder.store(after, self.here)
        kept = value if inside is None else builder.select(inside, value, stay)
        builder.store(kept, self.paths_in(plane), align=1)
        return value

    def finish(self, inside: Any) -> None:
        """Write the least costs."""
        lowest = self.builder.load(self.lowest)
        kept = lowest if inside is None else self.builder.select(inside, lowest, self.floor)
        self.builder.store(kept, self.least, align=1)


def _emit_step_lines(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Emit the instructions of `step_lines`; see there for the arguments."""

    def at(k: int, position: Any, kind: Any = _WORDS) -> Any:
        return element_pointer(context, builder, sig.args[k], args[k], position, kind)

    def unpack(k: int) -> list[Any]:
        return list(cgutils.unpack_tuple(builder, args[k], sig.args[k].count))

    voxel_at, before_at, after_at, voxel_step, sum_step, depth = unpack(1)
    stride, first, last, keep = unpack(8)

    def paths_in(line: Any) -> Callable[[Any], Any]:
        return lambda plane: at(5, builder.add(line, builder.mul(plane, stride)))

    p1 = everywhere(builder, args[2])
    directions = [
        _Paths(builder, at(3, penalty), at(6, least), paths_in(line), p1)
        for penalty, line, least in zip(unpack(4), unpack(7)[::2], unpack(7)[1::2], strict=True)
    ]
    inside = _inside(builder, first, last)
    keeps = builder.icmp_unsigned("!=", keep, ir.Constant(I64, 0))

    def all_planes(within: Any) -> None:
        for direction in directions:
            direction.begin()
        with cgutils.for_range(builder, depth) as loop:
            moved = builder.mul(loop.index, voxel_step)
            cost = builder.zext(load_unaligned(builder, at(0, builder.add(voxel_at, moved), _BYTES)), _WORDS)
            values = [direction.step(loop.index, cost, within) for direction in directions]
            with builder.if_then(keeps):
                moved = builder.mul(loop.index, sum_step)
                added = load_unaligned(builder, at(9, builder.add(before_at, moved)))
                for value in values:
                    added = builder.add(added, value)
                pointer = at(10, builder.add(after_at, moved))
                if within is None:
                    builder.store(added, pointer, align=1)
                else:  # another thread may be at work outside
                    kind = ir.FunctionType(ir.VoidType(), [_WORDS, pointer.type, I32, within.type])
                    store = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LINES}i16.p0")
                    builder.call(store, [added, pointer, ir.Constant(I32, 1), within])
        for direction in directions:
            direction.finish(within)

    whole = builder.icmp_unsigned("==", builder.sub(last, first), ir.Constant(I64, LINES))
    with builder.if_else(whole) as (all_lines, some):
        with all_lines:
            all_planes(None)
        with some:
            all_planes(inside)


@intrinsic
def step_lines(
    typingctx: Any,
    volume: Any,
    voxels: Any,
    p1: Any,
    penalties: Any,
    penalties_at: Any,
    state: Any,
    least: Any,
    lines: Any,
    counted: Any,
    before: Any,
    after: Any,
) -> Any:
    """Do what `kernels_sgm.step_plain` does, for some of the lines that a register holds, of one or more directions.

    Positions are uint64 and count elements of arrays of any rank; arrays must be contiguous.

    `volume`: uint8. `voxels`: where the register's first line is in the first plane of the volume, of `before` and of
    `after`; from a plane to the next in the volume, and in both sums; the number of planes. `p1`: uint16. `penalties`:
    uint16. `penalties_at`: for each direction, where the first line's is. `state`: uint16, the costs of the paths,
    plane after plane, with one beyond the last. `least`: uint16. `lines`: for each direction, where the first line is
    in the first plane of `state` and where in `least`. `counted`: from a plane to the next in `state`; the first of the
    lines that count and one past the last; 1 to write the sums, 0 not to. `before`: uint16, the sums of other paths.
    `after`: uint16, written: those with the paths of these directions.
    """
    signature = types.void(
        volume, voxels, types.uint16, penalties, penalties_at, state, least, lines, counted, before, after
    )

    return signature, _emit_step_lines


SIDE: Final = 16
"""Rows and columns of the blocks that are turned at once."""


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of a square block."""
    side = len(rows)
    masks = [
        ir.Constant(ir.VectorType(I32, side), [half * side // 2 + k // 2 + (k % 2) * side for k in range(side)])
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
        place = builder.add(position, builder.mul(step, ir.Constant(I64, k)))
        return load_unaligned(builder, element_pointer(context, builder, sig.args[0], source, place, kind))

    rows = [loaded(k, start) for k in range(SIDE)]
    if sources == 2:
        rows = [builder.add(row, loaded(k, builder.add(start, apart))) for k, row in enumerate(rows)]
    for k, column in enumerate(_turned(builder, rows)):
        place = builder.add(target_at, builder.mul(target_step, ir.Constant(I64, k)))
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
        _emit_turn(context, builder, sig, args, element=I8, sources=1)

    return signature, emit


@intrinsic
def turn_sums(
    typingctx: Any, source: Any, start: Any, apart: Any, step: Any, target: Any, target_at: Any, target_step: Any
) -> Any:
    """Do what `turn_bytes` does with the sum of two blocks, `apart` elements from each other, uint16."""
    place = types.uint64
    signature = types.void(source, place, place, place, target, place, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _emit_turn(context, builder, sig, args, element=I16, sources=2)

    return signature, emit


def _emit_step_planes(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the instructions of `step_planes`; see there for the arguments."""
    costs, cost_at, paths, before_at, now_at, registers, barred, jump, floor, p1 = args

    def at(k: int, array: Any, position: Any, kind: Any = _WORDS) -> Any:
        return element_pointer(context, builder, sig.args[k], array, position, kind)

    def shifted(first: Any, second: Any, start: int) -> Any:
        mask = ir.Constant(ir.VectorType(I32, LINES), [start + k for k in range(LINES)])
        return builder.shuffle_vector(first, second, mask)

    outside = ir.Constant(_WORDS, [60000] * LINES)
    floors, jumps, steps = (everywhere(builder, value) for value in (floor, jump, p1))
    lowest = cgutils.alloca_once_value(builder, outside)
    before = cgutils.alloca_once_value(builder, outside)
    here = cgutils.alloca_once_value(builder, load_unaligned(builder, at(2, paths, before_at)))
    with cgutils.for_range(builder, registers) as loop:
        plane = builder.mul(loop.index, ir.Constant(I64, LINES))
        following = builder.add(plane, ir.Constant(I64, LINES))
        stay = builder.load(here)
        # The row after the last one is there, but not its planes.
        after = load_unaligned(builder, at(2, paths, builder.add(before_at, following)))
        is_last = builder.icmp_unsigned("==", builder.add(loop.index, ir.Constant(I64, 1)), registers)
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
    kind = ir.FunctionType(I16, [_WORDS])
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

    `costs`: uint8; positions are uint64 and count elements. `cost_at`: where the pixel's first plane is. `paths`:
    uint16; a register more than the last pixel's can be read. `before_at`: where the first plane of the pixel before
    is. `now_at`: where that of this pixel is, which is written. `registers`: uint64, LINES planes in each. `barred`:
    uint16 for each plane: 0, or where there is none the least cost that it may get. `jump`: uint16, the least cost of
    the pixel before with P2. `floor`: uint16, the least cost of the pixel before. `p1`: uint16.
    """
    place, word = types.uint64, types.uint16
    signature = word(costs, place, paths, place, place, place, barred, word, word, word)
    return signature, _emit_step_planes
