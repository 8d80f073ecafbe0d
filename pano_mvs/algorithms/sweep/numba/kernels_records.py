"""The records that kernels take as arguments, and short names for array types in their signatures.

numba takes a `NamedTuple` as it takes its fields; it reads a record's fields from the caller at every call, so records
are passed to few, long calls. numba ignores annotations: arrays are checked by the function that prepares them.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
I16: TypeAlias = NDArray[np.int16]
I32: TypeAlias = NDArray[np.int32]
I64: TypeAlias = NDArray[np.int64]
U8: TypeAlias = NDArray[np.uint8]
U16: TypeAlias = NDArray[np.uint16]
U32: TypeAlias = NDArray[np.uint32]
U64: TypeAlias = NDArray[np.uint64]


class Sources(NamedTuple):
    """All sources; see `packing`.

    `poses`: (S, 3, 4) float64 source_from_reference. `packed`: (·,) uint32 `pack_plane` of all planes of all sources,
    or empty. `colors`: (·,) uint64 `pack_colors` of all sources, or empty; needs vector instructions. `starts`: (S, C
    or 1) int64, where the planes of each source begin, or its colours. `shapes`: (S, 2) int64 rows and columns of each
    source. `valid`: (·,) uint8 like a packed plane: whether a patch is valid; empty if all are. `valid_starts`: (S,)
    int64, where each source begins in `valid`. `masked`: (S, 2) int64, the first of a source's patches that is not
    valid, and the one after the last of these; equal if all are valid. `vector`: whether to use vector instructions;
    the result is the same.
    """

    poses: F64
    packed: U32
    colors: U64
    starts: I64
    shapes: I64
    valid: U8
    valid_starts: I64
    masked: I64
    vector: bool


class Windows(NamedTuple):
    """The windows around the pixels of the reference.

    `offsets`: (H, 2 compare_radius + 1) int64 columns of the window within which a pixel's cost looks around. `reach`:
    (H,) int64 columns on either side of the box over which costs are averaged. `compare_radius`: rows on either side
    within which a pixel's cost looks around. `box_radius`: rows of the box on either side. `pad`: columns of the margin
    of padded pictures, more than any window reaches.
    """

    offsets: I64
    reach: I64
    compare_radius: int
    box_radius: int
    pad: int


class Combination(NamedTuple):
    """How the costs of the sources become one; see `combine_row`.

    `weights`: (S, H, W) float32 of every source; empty if all are equal. `share`: of the weight that counts, in (0, 1].
    `max_count`: how many sources count at most. `neutral`: float32 mean cost where no source is valid.
    """

    weights: F32
    share: float
    max_count: int
    neutral: np.float32


class Sweep(NamedTuple):
    """What all bands of a sweep share.

    `reference`: (C, H + 2 pad, W + 2 pad) uint8, padded over the seam and the poles. `sin_cos_azimuth`: (2, W) float32
    sin θ and cos θ of the columns. `sources`: the sources. `windows`: the windows. `cost`: the number of the cost, see
    `kernels_constants`. `others`: None for census and census_gradient, which most workflows use: kernels that get None
    do not compile what other costs need. `census_weight`: of census beside grey levels; 0 for other costs.
    `combination`: how the costs of the sources become one. `scale`: float32 from mean costs to those of the volume, 0
    to 255; 0 keeps mean costs in `sweep_guided_band`.
    """

    reference: U8
    sin_cos_azimuth: F32
    sources: Sources
    windows: Windows
    cost: int
    others: bool | None
    census_weight: int
    combination: Combination
    scale: np.float32


class Lookup(NamedTuple):
    """What a lookup of a band in a source writes.

    `knots`: (2, `knot_rows`(rows), W) float32, scratch. `warped`: (C, rows, W + 2 pad) uint8, written unless `against`
    is there. `votes`: (rows, W) uint8, whether the source is valid there, written unless all patches are. `against`:
    (rows, W) uint32, what to compare with at once, see `add_sampled_differences`; or empty. `pixel_costs`: (rows, W + 2
    pad) uint16, to which differences from `against` are added.
    """

    knots: F32
    warped: U8
    votes: U8
    against: U32
    pixel_costs: U16


class Guide(NamedTuple):
    """The surface along which a guided sweep looks.

    `positions`: (rows, W) float32 among planes, of the rows that are looked up. `table`: (N,) float32 inverse ranges at
    the positions 0, 1/per_plane, 2/per_plane … `per_plane`: entries of the table for each plane.
    """

    positions: F32
    table: F32
    per_plane: int
