"""How far poses and ranges are from the truth."""
