"""Where units are computed: in this process, in worker processes, or on a dask cluster.

All executors do the same thing with the same unit: `Workplace.run` or `perform` call the stage on what the store holds
and put its result there. Values travel through the store alone; a worker is sent a description of the unit in JSON and
answers in JSON. No object is pickled.
"""
