"""What computes a sweep, chosen by name: numba (the default), numpy (readable), opencv, and plugins' backends."""
