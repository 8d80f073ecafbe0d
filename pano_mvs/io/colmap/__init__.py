"""Read and write COLMAP models, rigs and dense workspaces."""
