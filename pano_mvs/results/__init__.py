"""The output of a run: its summary (run.json), its values, loaded on access, and the verdict."""
