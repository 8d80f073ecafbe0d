"""Errors of camera poses."""
