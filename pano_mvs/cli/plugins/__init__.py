"""`pano-mvs plugins`, `plugin` and `stage`: list plugins, describe stages and write new plugins."""
