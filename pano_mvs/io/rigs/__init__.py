"""Rigs of fisheye cameras: calibration files, and the pictures of their captures."""
