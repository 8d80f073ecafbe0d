"""`pano-mvs doctor`: whether the installation, the machine and the folders are fit for a run, and what to do if not."""
