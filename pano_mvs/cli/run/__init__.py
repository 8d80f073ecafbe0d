"""`pano-mvs run`: progress on a terminal or as JSON lines, and the summary that is printed."""
