"""Pinhole views cut from a panorama: faces of a rig that covers the sphere with overlap."""
