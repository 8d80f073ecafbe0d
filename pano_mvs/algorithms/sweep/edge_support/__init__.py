"""Averages of the costs that follow the edges of the picture."""
