"""The probability that each camera of a model is right, from all that speaks for and against it."""
