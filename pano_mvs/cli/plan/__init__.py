"""`pano-mvs plan` and `status`: what a run would compute, and why."""
