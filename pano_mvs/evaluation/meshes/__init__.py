"""Comparison of meshes with panoramas that were not used to make them."""
