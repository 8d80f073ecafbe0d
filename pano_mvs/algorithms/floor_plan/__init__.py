"""Floor plans: storeys, lines of walls, rooms with openings, and an orthophoto of the floor."""
