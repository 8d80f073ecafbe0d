"""Windows, grid cells and steps that have the same extent everywhere on the sphere."""
