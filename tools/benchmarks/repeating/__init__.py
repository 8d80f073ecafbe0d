"""Synthetic places with repeated structure, for tests and benchmarks of pose solvers."""
