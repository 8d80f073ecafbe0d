"""Find the units of work of a workflow and their cache keys: which are cached, which must run, and why."""
