"""Floor plans: storeys, wall lines and an orthophoto of the floor from an upright cloud."""
