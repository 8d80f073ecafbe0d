"""Read and write point clouds and meshes."""
