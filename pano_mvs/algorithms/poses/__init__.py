"""Poses of a whole capture: tracks, scaled translations, bundle adjustment."""
