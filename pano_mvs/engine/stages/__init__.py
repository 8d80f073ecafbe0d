"""Declare, configure and register stages; plugin authors use this through `pano_mvs.api`."""
