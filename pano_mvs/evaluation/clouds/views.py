"""Pictures of a cloud coloured by its errors, seen from above, from outside and from inside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering.cloud import draw_cloud
from pano_mvs.algorithms.rendering.viewpoints import viewpoints
from pano_mvs.evaluation.clouds.overview import caption, distance_colors, distance_legend
from pano_mvs.scene.image_files.image_file import write_png

_SIZE_HW = (640, 1024)


def write_cloud_views(
    path: Path,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    distances: NDArray[np.float32],
    *,
    limits: Sequence[float],
    cameras: NDArray[np.float64],
    up: NDArray[np.float64],
    title: str,
) -> None:
    """Write a PNG of points coloured by their distances, with a legend.

    Args:
        path: the file to write; its folder is made.
        points: (N, 3) in the world.
        normals: (N, 3) towards the side that is seen, or 0: what shows its back is left out.
        distances: (N,) of each.
        limits: tolerances in rising order, by which points are coloured as of `distance_colors`.
        cameras: (M, 3) where cameras stood; from one of them the inside is seen.
        up: (3,) unit vector away from the ground.
        title: what is shown.
    """
    parts = [distance_legend(limits)]
    if len(points):
        colors = distance_colors(distances, limits)
        for view in viewpoints(points, cameras, up, aspect=_SIZE_HW[1] / _SIZE_HW[0]):
            parts += [caption(f"{title}, {view.title.lower()}"),
                      draw_cloud(points, normals, colors, view, size_hw=_SIZE_HW)]  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.vstack(parts))
