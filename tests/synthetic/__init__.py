"""Synthetic persons, cameras and places of the tests, beside those of `pano_mvs.testing`."""
