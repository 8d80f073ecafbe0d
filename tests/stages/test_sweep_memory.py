"""What dense stages say that they take in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.engine.stages.stage import spec_of
from pano_mvs.scene import FilePart, Panorama, RangeMap
from pano_mvs.stages.depth import SweepParams, exchange, patchmatch, sweep, sweep_memory_bytes
from pano_mvs.stages.filters import bilateral_solver, consistency, fill, planes

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
