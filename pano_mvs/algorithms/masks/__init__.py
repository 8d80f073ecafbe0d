"""Detect image areas to be ignored."""
