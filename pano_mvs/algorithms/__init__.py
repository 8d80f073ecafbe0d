"""What the product exists for: arrays and scene records in, arrays and scene records out; no disk, no settings file."""
