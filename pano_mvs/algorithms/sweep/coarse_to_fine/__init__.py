"""The faster sweep: half the resolution guides the full one. Needs numba."""
