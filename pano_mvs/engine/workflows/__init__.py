"""Read, merge and validate workflow files, and connect their stages to a graph."""
