"""Declare, configure and register stages; what a plugin author uses through `pano_mvs.api`."""
