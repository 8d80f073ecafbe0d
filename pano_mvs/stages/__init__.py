"""The built-in stages, one module per kind: each binds its parameters to an algorithm, nothing more."""
