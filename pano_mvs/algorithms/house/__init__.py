"""Put the groups of cameras and the single panoramas of a capture into one house."""
