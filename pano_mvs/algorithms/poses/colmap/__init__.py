"""Pose solvers that run COLMAP; the only place besides `io.colmap` that may import pycolmap."""
