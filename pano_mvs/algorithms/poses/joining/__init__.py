"""Join groups of cameras, such as rooms that see each other through doors only."""
