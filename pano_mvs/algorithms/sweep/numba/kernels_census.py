"""Compiled: census costs of a row, by vector instructions where the machine has them."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_cost import census_row
from pano_mvs.algorithms.sweep.numba.kernels_records import I64, U8
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import CENSUS_PIXELS, HAS_VECTOR, census_block
from pano_mvs.core.kernels import kernel

_U = np.uint64


@kernel
def count_census_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, offsets: I64, pad: int, disagree: U8
) -> None:
    """Do what `census_row` does, which shorter rows are left to. Both pictures must be as wide as each other."""
    width = disagree.shape[0]
    if not HAS_VECTOR or width < CENSUS_PIXELS:
        census_row(reference, reference_row, warped, warped_row, offsets, pad, disagree)
        return
    flat_reference, flat_warped = reference.reshape(-1), warped.reshape(-1)
    stride, side = reference.shape[1], offsets.shape[0]
    ours, theirs = reference_row * stride + pad, warped_row * stride + pad
    for i in range(0, width, CENSUS_PIXELS):
        at = min(i, width - CENSUS_PIXELS)  # the last block overlaps the one before it
        census_block(
            flat_reference, _U(ours + at), flat_warped, _U(theirs + at), _U(stride), offsets, _U(side), disagree, _U(at)
        )
