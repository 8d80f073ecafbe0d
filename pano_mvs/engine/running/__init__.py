"""Run a workflow: `run` has the whole flow and uses the dispatcher, the publisher and the statistics."""
