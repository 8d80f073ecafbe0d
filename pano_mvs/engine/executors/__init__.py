"""Compute units: in this process, in worker processes, or on a dask cluster.

All executors end in `unit_outcome`, which calls the stage on its inputs in the cache and stores the result there.
Values are passed only through the cache. Workers receive a description of the unit as JSON and answer in JSON; nothing
is pickled.
"""
