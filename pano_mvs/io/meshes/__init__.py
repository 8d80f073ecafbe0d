"""Write textured meshes."""
