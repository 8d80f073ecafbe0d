"""What a run made, looked at: the window of `pano-mvs view`, and one pixel of a sweep for `pano-mvs inspect`."""
