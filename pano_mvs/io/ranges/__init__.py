"""Read and write range maps."""
