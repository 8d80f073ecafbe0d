"""Implementations of the sweep, chosen by name: numba (the default), numpy (readable), opencv, and those of plugins."""
