"""Display results: the window of `pano-mvs view`, and the analysis of a pixel for `pano-mvs inspect`."""
