"""Export stages: files that other programs open."""
