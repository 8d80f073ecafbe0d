"""The sphere sweep: find ranges by testing depth hypotheses."""
