"""The commands `pano-mvs evaluate …`: options and printing; the work is done in `pano_mvs.evaluation`."""
