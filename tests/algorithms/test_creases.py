"""How clear the edges of walls are, beside the same in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.structure.kernels_creases import edge_clarities
from pano_mvs.algorithms.structure.skyline import mean_along

APART_RAD, FULL_LEVELS = 0.05, 20.0


@pytest.mark.kernel("structure.kernels_creases")
@pytest.mark.parametrize("half_window", [1, 4])
def test_edges_are_as_clear_as_the_mean_difference_along_them(half_window: int) -> None:
    rng = np.random.default_rng(3)
    rows, azimuths, walls = 91, 24, 5
    differences = rng.normal(0, 10, (rows, azimuths, 3)).astype(np.float32)
    distances = rng.uniform(0.4, 6.0, (walls, azimuths))
    distances[rng.random(distances.shape) < 0.3] = np.nan
    distances[0] = np.nan
    heights = np.array([-1.5, -1.6, -1.4, -0.7, 1.2, 0.0])
    found = np.empty((len(heights), walls, azimuths), np.float32)
    edge_clarities(differences, distances, heights, APART_RAD, half_window, FULL_LEVELS, found)

    elevations = np.arctan2(heights[:, None, None], distances)
    counted = np.isfinite(elevations) & (np.abs(elevations - elevations[0]) > APART_RAD)
    counted[0] = np.isfinite(distances)
    places = np.where(counted, (elevations + np.pi / 2) / np.pi * (rows - 1), 0.0)
    below = np.minimum(places.astype(int), rows - 2)
    part = (places - below)[..., None]
    columns = np.arange(azimuths)
    seen = differences[below, columns] * (1 - part) + differences[below + 1, columns] * part
    for idx, expected in enumerate(seen * counted[..., None]):
        sizes = np.linalg.norm(mean_along(expected, half_window), axis=-1)
        assert found[idx] == pytest.approx(np.sqrt(np.minimum(sizes / FULL_LEVELS, 1.0)), abs=1e-6)
    assert not found[:, 0].any()
