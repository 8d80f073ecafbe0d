"""The planes of a place: found in all range maps, placed by the lines where they meet, and laid into each view."""
