"""Select evenly distributed points from many range maps, with the views that see them."""
