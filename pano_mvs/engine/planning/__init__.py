"""From a wired workflow to units of work with cache keys: what is cached, what has to run and why."""
