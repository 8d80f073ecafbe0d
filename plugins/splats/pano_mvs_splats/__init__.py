"""Files for trainers of Gaussian splats and radiance fields: nerfstudio, and a bundle with everything they read."""
