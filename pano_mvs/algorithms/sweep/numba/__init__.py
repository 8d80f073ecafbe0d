"""The compiled sweep: kernels, their arguments, tiles, threads; `kernels_constants` alone does not import numba."""
