"""Few points out of many range maps: evenly spread, each with the views that see it."""
