"""Estimate the lenses of a two-lens camera from the pictures of a capture.

calibrate   from pictures to a calibration, in rounds of matching and adjustment
circles     the image circle of a lens in its pictures
adjustment  bundle adjustment of lenses, the pose of one in the other, cameras and points
"""
