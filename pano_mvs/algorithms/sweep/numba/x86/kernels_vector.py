"""Compiled to vector instructions of x86: bilinear samples of several neighbouring pixels at once.

numba's loops cannot express a load of a whole 2×2 patch, nor multiplications that add up in pairs (PMADDWD), so these
pieces are written as LLVM instructions, for registers of 16, 32 or 64 bytes, whichever this machine has. Their
arithmetic is that of `kernels_warp.blend_row`, to the bit.
"""

from __future__ import annotations

import re
from typing import Any, Final

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from pano_mvs.algorithms.sweep.kernels_constants import HALFWAY_ROUND, HALFWAY_SHIFT, ROUND, SHIFT


def features_of_this_machine() -> frozenset[str]:
    """Return the names of its instructions, as LLVM names them, for which numba compiles.

    Those are the ones in NUMBA_CPU_FEATURES if that is set, none beyond the baseline if NUMBA_CPU_NAME is generic, and
    no AVX if NUMBA_ENABLE_AVX is 0. Any other instruction would end the process when it is compiled.
    """
    stated = numba.config.CPU_FEATURES
    return frozenset(re.findall(r"\+([^,\s]+)", get_host_cpu_features() if stated is None else stated))


def _lanes_of_this_machine() -> int:
    """Return how many 16-byte lanes its widest registers have that can be shuffled by bytes; 0 if they cannot."""
    features = features_of_this_machine()
    return next((lanes for lanes, needed in ((4, "avx512bw"), (2, "avx2"), (1, "ssse3")) if needed in features), 0)


_LANES = _lanes_of_this_machine()
HAS_VECTOR: Final = _LANES > 0 and not numba.config.DISABLE_JIT
"""Whether the functions of this module can be called here."""

PIXELS: Final = 4 * max(_LANES, 1)
"""How many pixels one call samples."""

REGISTER_BYTES: Final = 16 * max(_LANES, 1)

_BITS = {1: "128", 2: "", 4: "512"}
# Where a patch of `packing.pack_colors` has {upper, lower} left, {upper, lower} right of R, of G, of B and of nothing.
_COLOR_PAIRS = [0, 1, 8, 9, 2, 3, 10, 11, 4, 5, 12, 13, 6, 7, 14, 15]
I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_NAMES = {
    "pairs": {1: "llvm.x86.sse2.pmadd.wd", 2: "llvm.x86.avx2.pmadd.wd", 4: "llvm.x86.avx512.pmaddw.d.512"},
    "to_words": {1: "llvm.x86.sse2.packssdw.128", 2: "llvm.x86.avx2.packssdw", 4: "llvm.x86.avx512.packssdw.512"},
    "to_bytes": {1: "llvm.x86.sse2.packsswb.128", 2: "llvm.x86.avx2.packsswb", 4: "llvm.x86.avx512.packsswb.512"},
}


def _vector(element: ir.IntType) -> ir.VectorType:
    return ir.VectorType(element, 128 * max(_LANES, 1) // element.width)


def _call(builder: Any, what: str, to: ir.IntType, *operands: Any) -> Any:
    """Emit one of the instructions of `_NAMES` on two whole registers."""
    kind = ir.FunctionType(_vector(to), [operand.type for operand in operands])
    function = cgutils.get_or_insert_function(builder.module, kind, _NAMES[what][_LANES])
    return builder.call(function, operands)


def _shuffle(builder: Any, first: Any, second: Any, mask: list[int]) -> Any:
    kind = ir.VectorType(I32, len(mask))
    return builder.shuffle_vector(first, second, ir.Constant(kind, mask))


def _constant(element: ir.IntType, value: int) -> Any:
    kind = _vector(element)
    return ir.Constant(kind, [value] * kind.count)


def element_pointer(context: Any, builder: Any, array_type: Any, array: Any, position: Any, to: Any) -> Any:
    """Return a pointer to `position` of an array of any rank, counted in elements, as a pointer to `to`."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [position]), to.as_pointer())


def load_unaligned(builder: Any, pointer: Any) -> Any:
    """Return what a pointer points to, wherever that is."""
    loaded = builder.load(pointer)
    loaded.align = 1
    return loaded


def _in_lanes(within: list[int]) -> list[int]:
    """Return a mask that shuffles the bytes of every lane alike; byte 16 is zero."""
    whole = 16 * _LANES
    return [whole if byte == 16 else 16 * lane + byte for lane in range(_LANES) for byte in within]


def _blend(builder: Any, patches: Any, order: list[int], weights_y: tuple[Any, Any], weight_x: Any) -> Any:
    """Return patches blended, as int32 around 0.

    `builder`: of the function. `patches`: a register of signed bytes. `order`: for each lane, its bytes in pairs
    {upper, lower}, left and right in turn. `weights_y`: the weights of the first and of the second half of the pairs of
    each lane. `weight_x`: the weights of the pairs {left, right} that the rows' blending leaves.
    """
    zero = _constant(I8, 0)
    sides = []
    for half, weight in zip((order[:8], order[8:]), weights_y, strict=True):
        # A byte behind a zero is a word 256 times as large, sign and all.
        mask = _in_lanes([place for byte in half for place in (16, byte)])
        words = builder.bitcast(_shuffle(builder, patches, zero, mask), _vector(I16))
        side = _call(builder, "pairs", I32, words, builder.bitcast(weight, _vector(I16)))
        side = builder.add(side, _constant(I32, HALFWAY_ROUND << 8))
        sides.append(builder.ashr(side, _constant(I32, HALFWAY_SHIFT + 8)))
    both = _call(builder, "to_words", I16, *sides)
    blended = _call(builder, "pairs", I32, both, builder.bitcast(weight_x, _vector(I16)))
    return builder.ashr(builder.add(blended, _constant(I32, ROUND)), _constant(I32, SHIFT))


def _spread(builder: Any, weights: Any, within: list[int]) -> Any:
    """Return the weights of four pixels a lane, rearranged in every lane alike."""
    mask = [4 * lane + pixel for lane in range(_LANES) for pixel in within]
    return _shuffle(builder, weights, weights, mask)


def _unsigned_byte(builder: Any, values: Any) -> Any:
    """Return int32 around 0 as bytes around 128."""
    kind = ir.VectorType(I8, values.type.count)
    return builder.xor(builder.trunc(values, kind), ir.Constant(kind, [128] * kind.count))


@intrinsic
def blend_grey_block(typingctx: Any, patches: Any, weight_y: Any, weight_x: Any, at: Any, out: Any, out_at: Any) -> Any:
    """Blend patches `at` … of one colour, into `out_at` … of `out`, uint8; the positions are counted in elements."""
    signature = types.void(patches, weight_y, weight_x, types.uint64, out, types.uint64)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = _vector(I32)
        loaded = [
            load_unaligned(builder, element_pointer(context, builder, sig.args[k], args[k], args[3], whole))
            for k in range(3)
        ]
        weights_y = _spread(builder, loaded[1], [0, 0, 1, 1]), _spread(builder, loaded[1], [2, 2, 3, 3])
        values = _blend(builder, builder.bitcast(loaded[0], _vector(I8)), list(range(16)), weights_y, loaded[2])
        target = element_pointer(context, builder, sig.args[4], args[4], args[5], ir.VectorType(I8, whole.count))
        builder.store(_unsigned_byte(builder, values), target, align=1)

    return signature, emit


def _patches(context: Any, builder: Any, packed: tuple[Any, Any], base: Any, places: list[Any]) -> Any:
    """Return the patches at `places`, one to a lane."""
    loaded = []
    for place in places:
        position = builder.add(base, builder.zext(place, I64))
        pointer = element_pointer(context, builder, *packed, position, ir.VectorType(I8, 16))
        loaded.append(load_unaligned(builder, pointer))
    while len(loaded) > 1:
        both = list(range(2 * loaded[0].type.count))
        loaded = [_shuffle(builder, loaded[i], loaded[i + 1], both) for i in range(0, len(loaded), 2)]
    return loaded[0]


def _rgb_bytes(context: Any, builder: Any, packed: tuple[Any, Any], base: Any, rows: list[Any]) -> Any:
    """Return R, G, B, 0 of all pixels as int32, from pointers to their indices, and vectors of their weights.

    Register m takes the pixels m, 4 + m, 8 + m, …, one to a lane, so that packing four registers, which works within
    lanes, puts the pixels in order.
    """
    index, weight_y, weight_x = rows
    blended = []
    for m in range(4):
        pixels = [4 * lane + m for lane in range(_LANES)]
        places = [builder.load(builder.gep(index, [ir.Constant(I32, pixel)])) for pixel in pixels]
        patches = _patches(context, builder, packed, base, places)
        down, across = (_spread(builder, weight, [m] * 4) for weight in (weight_y, weight_x))
        blended.append(_blend(builder, patches, _COLOR_PAIRS, (down, down), across))
    low = _call(builder, "to_words", I16, blended[0], blended[1])
    high = _call(builder, "to_words", I16, blended[2], blended[3])
    return builder.bitcast(_call(builder, "to_bytes", I8, low, high), _vector(I32))


@intrinsic
def sample_rgb_block(
    typingctx: Any,
    packed: Any,
    base: Any,
    index: Any,
    weight_y: Any,
    weight_x: Any,
    at: Any,
    out: Any,
    out_at: Any,
    out_step: Any,
) -> Any:
    """Sample pixels `at` … in a source packed from `base`, into `out_at` …; each next colour `out_step` further on."""
    place = types.uint64
    signature = types.void(packed, place, index, weight_y, weight_x, place, out, place, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = _vector(I32)
        rows = [element_pointer(context, builder, sig.args[2], args[2], args[5], I32)]
        rows += [
            load_unaligned(builder, element_pointer(context, builder, sig.args[k], args[k], args[5], whole))
            for k in (3, 4)
        ]
        pixels = _rgb_bytes(context, builder, (sig.args[0], args[0]), args[1], rows)
        target = args[7]
        for color in range(3):
            values = builder.lshr(pixels, _constant(I32, 8 * color))
            place = element_pointer(context, builder, sig.args[6], args[6], target, ir.VectorType(I8, whole.count))
            builder.store(_unsigned_byte(builder, values), place, align=1)
            target = builder.add(target, args[8])

    return signature, emit


@intrinsic
def difference_rgb_block(
    typingctx: Any,
    packed: Any,
    base: Any,
    index: Any,
    weight_y: Any,
    weight_x: Any,
    at: Any,
    reference: Any,
    reference_at: Any,
    total: Any,
    total_at: Any,
) -> Any:
    """Sample as `sample_rgb_block` does and add |R − r| + |G − g| + |B − b| to `total`, uint16.

    `reference` holds its pixels as R | G << 8 | B << 16, uint32; the positions are counted in elements.
    """
    place = types.uint64
    signature = types.void(packed, place, index, weight_y, weight_x, place, reference, place, total, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole, byte = _vector(I32), _constant(I32, 255)
        rows = [element_pointer(context, builder, sig.args[2], args[2], args[5], I32)]
        for k in (3, 4):
            rows.append(
                load_unaligned(builder, element_pointer(context, builder, sig.args[k], args[k], args[5], whole))
            )
        pixels = _rgb_bytes(context, builder, (sig.args[0], args[0]), args[1], rows)
        theirs = builder.bitcast(builder.xor(pixels, _constant(I32, 0x808080)), _vector(I8))
        ours = load_unaligned(builder, element_pointer(context, builder, sig.args[6], args[6], args[7], _vector(I8)))
        larger = builder.icmp_unsigned(">", ours, theirs)
        both = builder.select(larger, ours, theirs), builder.select(larger, theirs, ours)
        difference = builder.bitcast(builder.sub(*both), whole)
        added = builder.and_(difference, byte)
        for color in (1, 2):
            added = builder.add(added, builder.and_(builder.lshr(difference, _constant(I32, 8 * color)), byte))
        narrow = ir.VectorType(I16, whole.count)
        target = element_pointer(context, builder, sig.args[8], args[8], args[9], narrow)
        builder.store(builder.add(load_unaligned(builder, target), builder.trunc(added, narrow)), target, align=1)

    return signature, emit


CENSUS_PIXELS: Final = 4 * PIXELS
"""How many pixels one call of `census_block` compares."""


@intrinsic
def census_block(
    typingctx: Any,
    reference: Any,
    reference_at: Any,
    warped: Any,
    warped_at: Any,
    stride: Any,
    offsets: Any,
    side: Any,
    out: Any,
    out_at: Any,
) -> Any:
    """Do what `kernels_cost.census_row` does for some pixels, the counts staying in a register.

    `reference`: (·,) uint8. `reference_at`: where the first pixel is. `warped`: (·,) uint8. `warped_at`: likewise.
    `stride`: from a row to the next, of both. `offsets`: (side,) int64 columns of the window. `side`: of the window.
    `out`: (·,) uint8, written. `out_at`: where.
    """
    place = types.uint64
    signature = types.void(reference, place, warped, place, place, offsets, place, out, place)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = _vector(I8)
        pictures = ((sig.args[0], args[0], args[1]), (sig.args[2], args[2], args[3]))
        centers = [
            load_unaligned(builder, element_pointer(context, builder, kind, data, at, whole))
            for kind, data, at in pictures
        ]
        count = cgutils.alloca_once_value(builder, _constant(I8, 0))
        half = builder.lshr(args[6], ir.Constant(I64, 1))
        with cgutils.for_range(builder, args[6]) as rows, cgutils.for_range(builder, args[6]) as columns:
            below = builder.mul(builder.sub(rows.index, half), args[4])
            column = builder.load(element_pointer(context, builder, sig.args[5], args[5], columns.index, I64))
            shift = builder.add(below, column)
            larger = []
            for (kind, data, at), center in zip(pictures, centers, strict=True):
                pointer = element_pointer(context, builder, kind, data, builder.add(at, shift), whole)
                larger.append(builder.icmp_unsigned(">", load_unaligned(builder, pointer), center))
            differs = builder.sext(builder.xor(*larger), whole)
            builder.store(builder.sub(builder.load(count), differs), count)
        target = element_pointer(context, builder, sig.args[7], args[7], args[8], whole)
        builder.store(builder.load(count), target, align=1)

    return signature, emit
