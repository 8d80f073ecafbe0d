"""Semi-global matching in parts: they cover everything, keep within their memory, and change next to nothing."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.sweep.backends.numba_backend import VOLUME_BYTES, volume_parts
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.testing.room import capture_poses, default_room, render

LIMITS = [(128, 0.02), (160, 0.005), (512, 0.1), (4096, 4.0), (4096, 8.0), (64, 1e-6)]


@pytest.mark.parametrize(("rows", "limit"), LIMITS)
def test_parts_cover_all_rows_once_and_know_what_is_around_them(rows: int, limit: float) -> None:
    settings = SweepSettings(volume_limit_gb=limit)
    parts = volume_parts((rows, 2 * rows), settings)
    assert [row for part in parts for row in range(part.rows.start, part.rows.stop)] == list(range(rows))
    for part in parts:
        assert part.around.start == 0 or part.rows.start - part.around.start >= rows / 20
        assert part.around.stop == rows or part.around.stop - part.rows.stop >= rows / 20
        volume = VOLUME_BYTES * (part.around.stop - part.around.start) * 2 * rows * settings.planes
        assert volume <= limit * 1e9 or part.rows.stop - part.rows.start <= 32


def test_matching_in_parts_finds_what_matching_at_once_does() -> None:
    views_at = capture_poses(2, seed=5)
    pictures = [render(default_room(1), pose, (256, 512), supersample=1)[0] for pose in views_at]
    poses = [views_at[1] @ views_at[0].inverse()]
    settings = SweepSettings(planes=24, exposure=False)
    limited = settings.replace(volume_limit_gb=0.005)
    whole = sweep_range(pictures[0], pictures[1:], poses, near=0.5, far=6.0, settings=settings)
    parts = sweep_range(pictures[0], pictures[1:], poses, near=0.5, far=6.0, settings=limited)
    assert len(volume_parts((256, 512), limited)) > 2
    same = np.isclose(parts.range, whole.range, rtol=1e-3, equal_nan=True)
    assert same.mean() > 0.995
    assert same[[0, -1]].mean() > 0.99
