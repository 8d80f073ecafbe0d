"""Executors on other machines (dask, SLURM, PBS, LSF, SGE), and `cache push` and `cache pull`."""
