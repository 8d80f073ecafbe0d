"""The coarse-to-fine sweep: a sweep at half the resolution guides the full one. It needs numba."""
