"""Accuracy and completeness of clouds."""
