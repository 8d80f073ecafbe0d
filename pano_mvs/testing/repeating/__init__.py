"""Synthetic places with repeated structure."""
