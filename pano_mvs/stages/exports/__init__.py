"""Export stages: files for other programs."""
