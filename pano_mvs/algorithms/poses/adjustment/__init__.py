"""Tracks, triangulation and angular bundle adjustment."""
