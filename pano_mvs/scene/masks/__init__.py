"""Masked and cropped panoramas: placing masks and crops, filling masked pixels."""
