"""Pose solvers that run COLMAP; only this package and `io.colmap` may import pycolmap."""
