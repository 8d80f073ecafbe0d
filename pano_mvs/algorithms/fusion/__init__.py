"""From range maps to one cloud."""
