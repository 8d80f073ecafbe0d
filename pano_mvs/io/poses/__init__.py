"""Read and write camera poses in every supported format."""
