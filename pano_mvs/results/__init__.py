"""What a run made: its summary (run.json), its values on demand, and a verdict on them."""
