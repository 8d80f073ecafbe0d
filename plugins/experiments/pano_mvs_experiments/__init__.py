"""Experiments with settings: many runs of a workflow, side by side."""
