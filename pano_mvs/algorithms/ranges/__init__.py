"""What views see where the points of other views land, and which of them agree."""
