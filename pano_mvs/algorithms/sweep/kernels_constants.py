"""Constants that are compiled into the kernels and used elsewhere, too. This module does not import numba.

The folder of compiled kernels is named by the text of all files `kernels_*.py`; a constant anywhere else could change
without the kernels being compiled again.
"""

from __future__ import annotations

# The cost that `kernels_source_cost` computes.
CENSUS, ZNCC, SAD, SAD_GRADIENT, CENSUS_GRADIENT = range(5)

# Truncated costs: differences of colours, summed over R, G and B, in grey levels …
MAX_COLOR_COST = 30
# … and differences of gradients (over two pixels), summed over R, G and B and over both directions.
MAX_GRADIENT_COST = 60
# "census_gradient": a grey level of difference counts this many times.
GREY_WEIGHT = 8
# The variance of noise, in grey levels squared, that is added to the variance of every window.
ZNCC_NOISE_VARIANCE = 4.0
# Sources hold the share that is asked for although their weights, added up, fall short of it by rounding.
ENOUGH = 1 - 1e-5
# Weights of bilinear samples in integers, see `kernels_lookup.blend_row`.
UNIT, HALFWAY_SHIFT, SHIFT = 16384, 6, 22
HALFWAY_ROUND, ROUND = 1 << (HALFWAY_SHIFT - 1), 1 << (SHIFT - 1)
