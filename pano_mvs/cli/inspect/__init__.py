"""`pano-mvs inspect`: print the analysis of one pixel."""
