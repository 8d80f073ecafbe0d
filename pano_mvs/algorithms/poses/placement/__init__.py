"""Incremental registration: where the pairs of an image place it, and how a model grows."""
