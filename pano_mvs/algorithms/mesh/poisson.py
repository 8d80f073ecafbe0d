"""Screened Poisson surface reconstruction (Kazhdan & Hoppe, ACM TOG 32(3), 2013), by COLMAP's solver."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file

MIN_POINTS = 100
_SHALLOWEST, _DEEPEST = 5, 12
_TOLD = 300

# The solver crashes on some clouds, so it runs in a separate process. One cause is its own trimming, which is off. With
# several threads, the order of its sums is undefined, and the same cloud would give different bytes.
_SOLVE = """
import sys
import pycolmap
source, target, depth, point_weight = sys.argv[1:]
options = pycolmap.PoissonMeshingOptions()
options.depth, options.point_weight = int(depth), float(point_weight)
options.trim, options.color, options.num_threads = 0.0, True, 1
pycolmap.poisson_meshing(source, target, options)
"""


def poisson_depth(points: NDArray[np.float32], spacing: float) -> int:
    """Return the octree depth whose smallest cells are about as wide as the spacing of points (N, 3), 5 to 12.

    Args:
        points: at least two points.
        spacing: median distance to their neighbours, scene units.
    """
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    cells = max(1.1 * extent / max(spacing, 1e-12), 1.0)  # the solver's cube is a tenth wider than the cloud
    return int(np.clip(np.ceil(np.log2(cells)), _SHALLOWEST, _DEEPEST))


def solve_poisson(cloud_file: Path, folder: Path, *, depth: int, point_weight: float) -> Path:
    """Compute a closed surface through oriented points, with their colours, as a PLY file of triangles.

    Args:
        cloud_file: binary PLY with x y z nx ny nz red green blue, normals towards the side that was seen.
        folder: folder for the result.
        depth: depth of the octree; its smallest cells are extent / 2^depth wide.
        point_weight: how closely the surface follows the points; 0: the unscreened solver of 2006.

    Raises:
        InputError: if the solver fails.
    """
    target = folder / "poisson.ply"
    command = [sys.executable, "-c", _SOLVE, str(cloud_file), str(target), str(depth), str(point_weight)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603  # our own
    if done.returncode or not is_file(target):
        said = (done.stderr or done.stdout).strip()[-_TOLD:]
        raise InputError(
            f"the Poisson solver ended with code {done.returncode} at depth {depth}: try another `depth`, or fewer "
            f"points by `max_points`. Its message: {said or 'none'}"
        )
    return target
