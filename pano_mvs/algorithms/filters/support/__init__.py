"""Pixels that confirmed neighbours support."""
