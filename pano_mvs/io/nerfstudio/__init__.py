"""Write nerfstudio datasets."""
