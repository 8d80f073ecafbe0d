"""Descriptor matching and the choice of pairs."""
