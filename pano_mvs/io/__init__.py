"""Files of other people: readers and writers."""
