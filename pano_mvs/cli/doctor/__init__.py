"""`pano-mvs doctor`: check whether the installation, the machine and the folders are fit for a run."""
