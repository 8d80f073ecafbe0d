"""Floor plans: rooms, walls and openings of each storey, as drawings."""
