"""The cache on disk: immutable blobs, records by key, and maintenance."""
