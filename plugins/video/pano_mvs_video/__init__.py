"""Panoramic videos: their frames as a capture, chosen by the motion of the camera."""
