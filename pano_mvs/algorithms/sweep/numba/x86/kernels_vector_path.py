"""Compiled to vector instructions: one step of several neighbouring paths of semi-global matching, all planes.

The costs of the planes before and after stay in registers; a loop cannot be proved free of aliasing without more checks
than a strip has work.
"""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import REGISTER_BYTES, element_pointer, load_unaligned

LINES: Final = REGISTER_BYTES // 2
"""How many paths one call advances."""

_I16, _I32, _I64 = (ir.IntType(bits) for bits in (16, 32, 64))
_WORDS = ir.VectorType(_I16, LINES)
_BYTES = ir.VectorType(ir.IntType(8), LINES)


def _everywhere(builder: Any, value: Any) -> Any:
    first = builder.insert_element(ir.Constant(_WORDS, ir.Undefined), value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_I32, LINES), [0] * LINES))


def _least(builder: Any, first: Any, second: Any) -> Any:
    return builder.select(builder.icmp_unsigned("<", first, second), first, second)


def _inside(builder: Any, first: Any, last: Any) -> Any:
    """Return which of the lines are from `first` to before `last`."""
    lines = ir.Constant(_WORDS, list(range(LINES)))
    bounds = [_everywhere(builder, builder.trunc(bound, _I16)) for bound in (first, last)]
    return builder.and_(builder.icmp_unsigned(">=", lines, bounds[0]), builder.icmp_unsigned("<", lines, bounds[1]))


def _add(builder: Any, pointer: Any, value: Any, inside: Any, whole: Any) -> None:
    """Add to what a pointer points to, and write nothing outside: another thread may be at work there."""
    added = builder.add(load_unaligned(builder, pointer), value)
    with builder.if_else(whole) as (all_lines, some):
        with all_lines:
            builder.store(added, pointer, align=1)
        with some:
            kind = ir.FunctionType(ir.VoidType(), [_WORDS, pointer.type, _I32, inside.type])
            store = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LINES}i16.p0")
            builder.call(store, [added, pointer, ir.Constant(_I32, 1), inside])


def _emit_step_lines(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Emit the instructions of `step_lines`; see there for the arguments."""

    def at(k: int, position: Any, kind: Any = _WORDS) -> Any:
        return element_pointer(context, builder, sig.args[k], args[k], position, kind)

    voxel_at, voxel_step, depth = cgutils.unpack_tuple(builder, args[2], 3)
    line, stride, first, last = cgutils.unpack_tuple(builder, args[8], 4)
    inside = _inside(builder, first, last)
    whole = builder.icmp_unsigned("==", builder.sub(last, first), ir.Constant(_I64, LINES))
    keep = builder.icmp_unsigned("!=", args[9], ir.Constant(_I64, 0))
    least_at = at(7, line)
    floor = load_unaligned(builder, least_at)
    jump = builder.add(floor, load_unaligned(builder, at(4, args[5])))
    p1 = _everywhere(builder, args[3])
    outside = ir.Constant(_WORDS, [60000] * LINES)
    before = cgutils.alloca_once_value(builder, outside)
    here = cgutils.alloca_once_value(builder, load_unaligned(builder, at(6, line)))
    lowest = cgutils.alloca_once_value(builder, outside)
    with cgutils.for_range(builder, depth) as loop:
        position = builder.add(line, builder.mul(loop.index, stride))
        voxel = builder.add(voxel_at, builder.mul(loop.index, voxel_step))
        stay, after = builder.load(here), load_unaligned(builder, at(6, builder.add(position, stride)))
        near = builder.add(_least(builder, builder.load(before), after), p1)
        near = _least(builder, stay, _least(builder, near, jump))
        cost = builder.zext(load_unaligned(builder, at(0, voxel, _BYTES)), _WORDS)
        value = builder.add(builder.sub(near, floor), cost)
        builder.store(_least(builder, value, builder.load(lowest)), lowest)
        builder.store(stay, before)
        builder.store(after, here)
        builder.store(builder.select(inside, value, stay), at(6, position), align=1)
        with builder.if_then(keep):
            _add(builder, at(1, voxel), value, inside, whole)
    builder.store(builder.select(inside, builder.load(lowest), floor), least_at, align=1)


@intrinsic
def step_lines(
    typingctx: Any,
    volume: Any,
    total: Any,
    voxels: Any,
    p1: Any,
    penalties: Any,
    penalty_at: Any,
    state: Any,
    least: Any,
    lines: Any,
    keep: Any,
) -> Any:
    """Do what `kernels_sgm.step_plain` does, for some of the lines that a register holds.

    Args:
        typingctx: numba's.
        volume: uint8, of any rank; positions are counted in elements.
        total: uint16, of the volume's shape.
        voxels: three uint64: where in both the register's first line is in the first plane, from a plane to the next,
            the number of planes.
        p1: uint16.
        penalties: uint16.
        penalty_at: where the first line's is.
        state: (depth + 1, stride) uint16.
        least: (stride,) uint16.
        lines: four uint64: where the first line is in those, the stride of the state, the first of the lines that
            count and one past the last.
        keep: 1 to add to the total, 0 not to.
    """
    place = types.uint64
    signature = types.void(
        volume,
        total,
        types.UniTuple(place, 3),
        types.uint16,
        penalties,
        place,
        state,
        least,
        types.UniTuple(place, 4),
        place,
    )

    return signature, _emit_step_lines
