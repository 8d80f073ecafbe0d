"""Choose frames of a video by the motion of the camera."""
