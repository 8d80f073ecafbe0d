"""Check poses against the images, and resolve ambiguities of repeated structure."""
