"""Dense 3D from 360° photographs.

The command line is `pano-mvs`; a plugin author imports `pano_mvs.api`; the conventions (frames,
pixels, ranges) are stated once, in `pano_mvs.geometry`.
"""

__version__ = "0.1.0"
