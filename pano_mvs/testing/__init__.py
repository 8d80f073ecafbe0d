"""Synthetic scenes with exact truth, and checks for the authors of stages."""
