"""Pinhole pictures cut out of a panorama: faces of a rig that covers the sphere with overlap."""
