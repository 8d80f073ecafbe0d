"""Stages for rigs of fisheye lenses."""
