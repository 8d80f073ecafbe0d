"""Ranges of a neural network of your own, where no view saw a surface."""
