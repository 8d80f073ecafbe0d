"""The compiled sweep: kernels, their arguments, threads. All but `kernels_constants` import numba, so import on use."""
