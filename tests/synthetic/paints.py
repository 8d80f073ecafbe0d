"""Colours of the surfaces of synthetic scenes."""

from pano_mvs.testing.room import Colors

WHITE: Colors = ((0.86, 0.86, 0.84), (0.86, 0.86, 0.84))
OAK: Colors = ((0.62, 0.44, 0.27), (0.42, 0.28, 0.17))
BRICK: Colors = ((0.62, 0.36, 0.27), (0.50, 0.40, 0.33))
STONE: Colors = ((0.62, 0.60, 0.54), (0.47, 0.46, 0.44))
LEAVES: Colors = ((0.22, 0.42, 0.16), (0.40, 0.50, 0.22))
STEEL: Colors = ((0.36, 0.40, 0.46), (0.60, 0.60, 0.62))
BLUE: Colors = ((0.25, 0.38, 0.62), (0.45, 0.60, 0.75))
RED: Colors = ((0.70, 0.26, 0.22), (0.80, 0.52, 0.40))
