"""The world frame: gauge, gravity, metric scale and geodetic coordinates."""
