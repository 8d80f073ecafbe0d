"""Decode image files safely: headers, limits and damage."""
