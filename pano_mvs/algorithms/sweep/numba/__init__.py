"""The compiled sweep: kernels, their arguments, tiles and threads."""
