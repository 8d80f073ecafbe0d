"""Fusion of range maps into one cloud."""
