"""Inspect one pixel of a sweep: its cost curve, its sources and its range after each stage."""
