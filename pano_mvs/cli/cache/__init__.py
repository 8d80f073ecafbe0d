"""`pano-mvs cache`: inspect, verify and clean a cache."""
