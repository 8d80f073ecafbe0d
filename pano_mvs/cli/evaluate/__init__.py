"""The commands `pano-mvs evaluate …`: options and printing; `pano_mvs.evaluation` does the work."""
