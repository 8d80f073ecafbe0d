"""The window that shows the cloud, the mesh, the cameras and the panoramas of a run."""
