"""Faults that change nothing that the code promises, by their id, with the reason."""

EQUIVALENT: dict[str, str] = {}
