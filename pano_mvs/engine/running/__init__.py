"""Execute a workflow: start with `run`, which calls the scheduler, the dispatcher and the publisher."""
