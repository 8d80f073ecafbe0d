"""Refinement of range maps by slanted planes."""
