"""Workflows, plans, the store and execution; knows no stage by name."""
