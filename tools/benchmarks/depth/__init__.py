"""Benchmarks of the dense stages over many places at once."""
