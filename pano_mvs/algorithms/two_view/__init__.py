"""The geometry of two panoramas on unit bearings."""
