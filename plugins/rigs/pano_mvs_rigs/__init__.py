"""Two-lens cameras: calibrate their lenses from raw pictures, and stitch these to panoramas."""
