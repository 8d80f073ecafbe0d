"""Incremental registration: place an image by its pairs, and grow a model."""
