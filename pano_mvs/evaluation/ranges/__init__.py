"""Scores of range maps."""
