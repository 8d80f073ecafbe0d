"""Run workflows: from their files over plans to cached results. The engine knows no stage by name."""
