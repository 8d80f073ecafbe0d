"""Run workflows, from files and plans to cached results. The engine does not know any stage by name."""
