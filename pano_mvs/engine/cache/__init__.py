"""The disk cache: immutable blobs, records by key, and their maintenance."""
