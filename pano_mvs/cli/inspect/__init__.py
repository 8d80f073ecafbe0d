"""`pano-mvs inspect`: one pixel of a sweep, printed."""
