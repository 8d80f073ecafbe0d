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


@intrinsic
def step_lines(  # type: ignore[no-untyped-def]
    typingctx, volume, total, at, step, depth, p1, penalties, penalty_at, state, least, line, stride, first, last, keep
):
    """Do what `kernels_sgm.step_plain` does, for the lines `first` to before `last` of those a register holds.

    Args:
        typingctx: numba's.
        volume: uint8, of any rank; positions are counted in elements.
        total: uint16, of the volume's shape.
        at: where in both the register's first line is in the first plane.
        step: from a plane to the next.
        depth: number of planes.
        p1: uint16.
        penalties: uint16.
        penalty_at: where the first line's is.
        state: (depth + 1, stride) uint16.
        least: (stride,) uint16.
        line: where the first line is in those.
        stride: of the state.
        first: of the lines that count.
        last: one past them.
        keep: 1 to add to the total, 0 not to.
    """
    place = types.uint64
    signature = types.void(
        volume, total, place, place, place, types.uint16, penalties, place, state, least, place, place, place, place,
        place,
    )  # fmt: skip

    def emit(context, builder, sig, args):  # type: ignore[no-untyped-def]
        def at(k: int, position: Any, kind: Any = _WORDS) -> Any:
            return element_pointer(context, builder, sig.args[k], args[k], position, kind)

        inside = _inside(builder, args[12], args[13])
        count = builder.sub(args[13], args[12])
        whole = builder.icmp_unsigned("==", count, ir.Constant(_I64, LINES))
        keep = builder.icmp_unsigned("!=", args[14], ir.Constant(_I64, 0))
        least_at = at(9, args[10])
        floor = load_unaligned(builder, least_at)
        jump = builder.add(floor, load_unaligned(builder, at(6, args[7])))
        p1 = _everywhere(builder, args[5])
        outside = ir.Constant(_WORDS, [60000] * LINES)
        before = cgutils.alloca_once_value(builder, outside)
        here = cgutils.alloca_once_value(builder, load_unaligned(builder, at(8, args[10])))
        lowest = cgutils.alloca_once_value(builder, outside)
        with cgutils.for_range(builder, args[4]) as loop:
            position = builder.add(args[10], builder.mul(loop.index, args[11]))
            voxel = builder.add(args[2], builder.mul(loop.index, args[3]))
            stay, after = builder.load(here), load_unaligned(builder, at(8, builder.add(position, args[11])))
            near = builder.add(_least(builder, builder.load(before), after), p1)
            near = _least(builder, stay, _least(builder, near, jump))
            cost = builder.zext(load_unaligned(builder, at(0, voxel, _BYTES)), _WORDS)
            value = builder.add(builder.sub(near, floor), cost)
            builder.store(_least(builder, value, builder.load(lowest)), lowest)
            builder.store(stay, before)
            builder.store(after, here)
            builder.store(builder.select(inside, value, stay), at(8, position), align=1)
            with builder.if_then(keep):
                _add(builder, at(1, voxel), value, inside, whole)
        builder.store(builder.select(inside, builder.load(lowest), floor), least_at, align=1)

    return signature, emit
