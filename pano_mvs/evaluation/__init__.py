"""Comparison of poses, range maps and clouds with ground truth."""
