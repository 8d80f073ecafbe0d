"""Write splat bundles."""
