"""Runs side by side, what differs between two of them and why, and the way from a file back to its images."""
