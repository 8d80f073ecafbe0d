"""From pairs to the poses of all panoramas."""
