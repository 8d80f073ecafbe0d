"""What dense stages say that they take in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import spec_of
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, Panorama, Pose, RangeMap
from pano_mvs.stages import depth
from pano_mvs.stages.depth import PatchMatchParams, SweepParams, exchange, patchmatch, sweep, sweep_memory_bytes
from pano_mvs.stages.filters import bilateral_solver, consistency, fill, planes

MedianParams = Registry.installed().stages["filters.median"].params_type
GaussianParams = Registry.installed().stages["filters.gaussian"].params_type

PIXELS = 512 * 1024


def needed(**settings: Any) -> int:
    panoramas = [Panorama(FilePart(Path("x")), (512, 1024), (512, 1024)) for _ in range(4)]
    return sweep_memory_bytes(SweepParams(**settings), {"ref": panoramas[0], "sources": panoramas[1:]})


def test_the_volume_of_semi_global_matching_is_what_counts() -> None:
    assert needed(planes=256) - needed(planes=128) == 3 * 128 * PIXELS
    assert needed(planes=128, backend="numpy") > 6 * needed(planes=128)
    assert needed(planes=128) < 0.4e9


def test_without_a_volume_planes_cost_nothing() -> None:
    assert needed(planes=256, aggregation="box") == needed(planes=128, aggregation="box") < 0.1e9


def test_from_coarse_to_fine_the_volume_is_the_coarsest() -> None:
    plain, box = needed(), needed(aggregation="box")
    assert needed(levels=3) - box == (plain - box) // 16


def test_the_engine_is_told() -> None:
    spec = spec_of(sweep)
    assert spec is not None
    assert spec.memory_needed is sweep_memory_bytes


def test_volumes_end_at_their_limit() -> None:
    assert needed(planes=4096, volume_limit_gb=1.0) == needed(planes=1024, volume_limit_gb=1.0)
    assert needed(planes=512, volume_limit_gb=0.5) - needed(aggregation="box") == 500_000_000


@pytest.mark.parametrize(
    ("function", "least"),
    [(patchmatch, 175), (exchange, 269), (consistency, 150), (bilateral_solver, 166), (fill, 83), (planes, 149)],
)
def test_other_dense_stages_say_more_than_was_measured_with_three_sources(
    function: Callable[..., Any], least: int
) -> None:
    spec = spec_of(function)
    assert spec is not None
    assert spec.memory_needed is not None
    ranges = RangeMap(np.ones((64, 128), np.float32), np.full((64, 128), 255, np.uint8))
    inputs = {"range_map": ranges} | (
        {"sources": [ranges] * 3} if function in (patchmatch, exchange, consistency) else {}
    )
    assert 1.1 * least < spec.memory_needed(spec.params_type(), inputs) / (64 * 128) < 1.3 * least


SIZE = (128, 256)


@pytest.mark.parametrize(
    ("settings", "halvings", "levels", "rows"),
    [
        ({"scale": "nominal"}, 2, 0, [128]),
        ({"scale": "finer"}, 2, 0, [64]),
        ({"scale": "sharp"}, 2, 0, [32]),
        ({"scale": "finer"}, 1, 0, [128]),
        ({"scale": "sharp"}, 1, 0, [64]),
        ({"scale": "finer"}, 0, 0, [128]),
        ({"scale": "sharp"}, 0, 0, [128]),
        ({}, 0, 2, [32, 64, 128]),
        ({"multiscale": False}, 0, 2, [128]),
        ({"scale": "nominal"}, 0, 2, [128]),
    ],
)
def test_blurred_panoramas_are_swept_at_a_lower_and_large_ones_at_coarser_resolutions_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: Any, halvings: int, levels: int, rows: list[int]
) -> None:
    swept: list[int] = []

    def sweep_range(reference: Any, sources: Any, *_: Any, source_masks: Any, **__: Any) -> RangeMap:
        size = reference.shape[:2]
        assert reference.shape == (size[0], 2 * size[0], 3)
        assert sources[0].shape[:2] == source_masks[0].shape == size
        swept.append(size[0])
        return RangeMap(np.full(size, float(size[0]), np.float32), np.full(size, 100, np.uint8))

    monkeypatch.setattr(depth, "sharp_halvings", lambda picture: halvings)
    monkeypatch.setattr(depth, "coarser_levels", lambda size_hw: levels)
    monkeypatch.setattr(depth, "sweep_range", sweep_range)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((*SIZE, 3), 128, np.uint8))
    panorama = Panorama(FilePart(path), SIZE, SIZE)
    found = depth.sweep(
        ref=panorama,
        pose=Pose(Rigid3.identity()),
        sources=[panorama],
        source_poses=[Pose(Rigid3(np.eye(3), np.ones(3)))],
        known=None,
        params=depth.SweepParams(near=1.0, far=9.0, **settings),
        ctx=Context(np.random.default_rng(0), tmp_path),
    )
    assert swept == rows
    assert found.range.shape == SIZE, "the result has the size of the panorama"
    # Without any detail, the coarsest ranges are left.
    np.testing.assert_allclose(found.range, rows[0])


@pytest.mark.parametrize("params", [SweepParams, MedianParams, GaussianParams, PatchMatchParams])
def test_windows_are_odd(params: type) -> None:
    with pytest.raises(ValidationError, match="must be odd"):
        params(window=4)
    assert params(window=3).window == 3


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"support": 4}, r"support\s+.*must be odd"),
        ({"p2": 5000}, r"p2\s+.*less than or equal to 4000"),
        ({"p1": 1000, "p2": 500}, "0 ≤ p1 ≤ p2 ≤ 4000 must hold, got 1000 and 500"),
        ({"cost": "zncc", "window": 1}, "zncc needs a window of at least 3"),
        ({"near": 5.0, "far": 1.0}, "near must be less than far, got 5.0 and 1.0"),
        ({"near": 2.0, "far": 2.0}, "near must be less than far, got 2.0 and 2.0"),
    ],
)
def test_a_sweep_that_cannot_run_is_refused(settings: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        SweepParams.model_validate(settings)


@pytest.mark.parametrize(
    "settings",
    [{"p1": 4000, "p2": 4000}, {"cost": "sad", "window": 1, "support": 1}, {"near": 1.0, "far": 1.1}],
)
def test_the_largest_penalties_and_smallest_windows_are_taken(settings: dict[str, object]) -> None:
    params = SweepParams.model_validate(settings)
    assert params.model_dump(include=set(settings)) == settings
