"""Arrays in files equal those in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pano_mvs.io.growing_arrays import GrowingArrays


def test_rows_follow_each_other(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(count, 3)).astype(np.float32) for count in (4, 0, 3)]
    masks = [part[:, 0] > 0 for part in parts]
    with GrowingArrays(tmp_path / "new") as grown:
        for part, mask in zip(parts, masks, strict=True):
            grown.append({"points": part[:, ::-1], "masks": mask, "missing": None})
        found = grown.arrays()
    assert list(found) == ["points", "masks"]
    np.testing.assert_array_equal(found["points"], np.concatenate(parts)[:, ::-1])
    np.testing.assert_array_equal(found["masks"], np.concatenate(masks))


def test_arrays_without_rows_are_empty(tmp_path: Path) -> None:
    with GrowingArrays(tmp_path) as grown:
        grown.append({"points": np.zeros((0, 3), np.float32)})
        found = grown.arrays()
    assert found["points"].shape == (0, 3)
    assert found["points"].dtype == np.float32
