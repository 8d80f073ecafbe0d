"""Key points and matches by neural networks."""
