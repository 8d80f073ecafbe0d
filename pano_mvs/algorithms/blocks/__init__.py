"""Join blocks of a capture that were solved separately and have cameras in common."""
