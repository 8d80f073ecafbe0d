"""The compiled sweep: kernels, and the arrays that they read. Import only where numba is available."""
