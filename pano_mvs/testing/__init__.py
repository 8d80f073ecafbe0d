"""Synthetic scenes with exact ground truth, and contract tests for authors of stages."""
