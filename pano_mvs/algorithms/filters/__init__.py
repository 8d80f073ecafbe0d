"""Filters on range maps: they take and return a `RangeMap`."""
