"""Estimates and ground truth in files of any program or in memory, paired by image name."""
