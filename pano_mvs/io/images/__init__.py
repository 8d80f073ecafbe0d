"""Image and video files: captures, metadata, masks and previews."""
