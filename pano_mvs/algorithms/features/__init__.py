"""Key points and descriptors on the sphere."""
