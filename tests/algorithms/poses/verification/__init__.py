"""Poses checked against the images."""
