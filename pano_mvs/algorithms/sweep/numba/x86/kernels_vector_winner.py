"""Compiled to vector instructions: winner takes all, the running state of several neighbouring pixels in registers.

Too many arrays are read and written at once for a loop to be proved free of aliasing.
"""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import I64, REGISTER_BYTES, element_pointer, load_unaligned

# The rows of the running state.
BEST, BEFORE, AFTER, RIVAL, LAST, LAST_BUT_ONE, EARLIER = range(7)
STATES: Final = 7


def _less(builder: Any, first: Any, second: Any) -> Any:
    if isinstance(first.type.element, ir.FloatType):
        return builder.fcmp_ordered("<", first, second)
    return builder.icmp_unsigned("<", first, second)


def _least(builder: Any, first: Any, second: Any) -> Any:
    return builder.select(_less(builder, first, second), first, second)


def _take(builder: Any, cost: Any, now: Any, state: list[Any], planes: Any) -> None:
    """Take in the costs of plane `now`; `state` and `planes` are pointers to registers. See `take_planes`."""
    best, before, after, rival, last, last_but_one, earlier = (builder.load(kept) for kept in state)
    winner = builder.load(planes)
    gap = builder.sub(now, winner)
    wins = _less(builder, cost, best)
    earlier = _least(builder, last_but_one, earlier)
    one = ir.Constant(winner.type, [1] * winner.type.count)
    kept_rival = builder.select(builder.icmp_unsigned(">", gap, one), _least(builder, cost, rival), rival)
    kept_after = builder.select(builder.icmp_unsigned("==", gap, one), cost, after)
    following = {
        BEST: builder.select(wins, cost, best),
        BEFORE: builder.select(wins, last, before),
        AFTER: builder.select(wins, cost, kept_after),
        RIVAL: builder.select(wins, earlier, kept_rival),
        LAST: cost,
        LAST_BUT_ONE: last,
        EARLIER: earlier,
    }
    for row, value in following.items():
        builder.store(value, state[row])
    builder.store(builder.select(wins, now, winner), planes)


@intrinsic
def take_planes(
    typingctx: Any,
    costs: Any,
    cost_at: Any,
    cost_step: Any,
    plane: Any,
    count: Any,
    state: Any,
    state_at: Any,
    state_step: Any,
    planes: Any,
    planes_at: Any,
) -> Any:
    """Do what `kernels_winner.update_plain` does for as many pixels as a register holds.

    `costs`: float32 or uint16, of any rank; positions are counted in elements. `cost_at`: where the first plane's are.
    `cost_step`: from a plane's to the next one's. `plane`: index of the first plane. `count`: of planes. `state`: of
    the costs' type. `state_at`: where its first row is. `state_step`: from a row to the next. `planes`: integers as
    wide as the costs. `planes_at`: where.
    """
    place = types.uint64
    signature = types.void(costs, place, place, place, place, state, place, place, planes, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element, index = (context.get_value_type(sig.args[k].dtype) for k in (0, 8))
        lanes = REGISTER_BYTES * 8 // index.width
        kind, indices = ir.VectorType(element, lanes), ir.VectorType(index, lanes)
        places = []
        for row in range(STATES):
            at = builder.add(args[6], builder.mul(args[7], ir.Constant(I64, row)))
            places.append(element_pointer(context, builder, sig.args[5], args[5], at, kind))
        kept = [cgutils.alloca_once_value(builder, load_unaligned(builder, pointer)) for pointer in places]
        pointer = element_pointer(context, builder, sig.args[8], args[8], args[9], indices)
        winner = cgutils.alloca_once_value(builder, load_unaligned(builder, pointer))
        with cgutils.for_range(builder, args[4]) as loop:
            at = builder.add(args[1], builder.mul(loop.index, args[2]))
            cost = load_unaligned(builder, element_pointer(context, builder, sig.args[0], args[0], at, kind))
            now = builder.trunc(builder.add(args[3], loop.index), index)
            first = builder.insert_element(ir.Constant(indices, ir.Undefined), now, ir.Constant(ir.IntType(32), 0))
            everywhere = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
            _take(builder, cost, builder.shuffle_vector(first, first, everywhere), kept, winner)
        for value, target in zip(kept, places, strict=True):
            builder.store(builder.load(value), target, align=1)
        builder.store(builder.load(winner), pointer, align=1)

    return signature, emit
