"""Scripts that the package and the default tests do not need; `python -m tools` lists them."""
