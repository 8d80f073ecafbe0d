"""Filters on range maps."""
