"""Nothing that is masked is seen by any stage, whatever its settings: no key point, range, point or pixel is of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.colmap.sift import colmap_sift
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import pixel_from_ray
from pano_mvs.scene import PointCloud, Pose, RangeMap
from pano_mvs.stages.fusion import vote
from pano_mvs.testing.conformance import stage_contract_tests
from pano_mvs.testing.tiny_capture import TinyCapture, Variant, tiny_capture

FusionParams = Registry.installed().stages["fusion.vote"].params_type

FEW = {"planes": 12, "near": 0.5, "far": 6.0}
BOX = FEW | {"aggregation": "box"}
SWEEPS: list[tuple[str, dict[str, Any]]] = [
    *(("depth.sweep", BOX | {"backend": b, "exposure": False}) for b in ("numpy", "opencv")),
    *(("depth.sweep", BOX | {"cost": cost}) for cost in ("sad", "census_gradient", "zncc", "sad_gradient")),
    *(("depth.sweep", BOX | {"combination": c}) for c in ("sum", "best_k", "parallax_weighted")),
    ("depth.sweep", FEW | {"levels": 2}),
]
VARIANTS: list[tuple[str, dict[str, Any]]] = [
    ("depth.sweep", FEW | {"cost": "sad", "prefilter_diameter": 5, "derotate": True}),
    ("depth.sweep", FEW | {"window": 15, "support": 15, "no_match": "keep"}),
    ("features.orb_tangent", {"max_keypoints": 50}),
    ("features.sift_tangent", {"max_keypoints": 50}),
    ("features.sphorb", {"max_keypoints": 50}),
    ("filters.fast_bilateral_solver", {"max_hole_deg": 0, "keep_confidence": 256, "domain": "range"}),
    ("filters.guided", {"fill": True, "radius": 9}),
    ("filters.fill", {"max_hole_deg": 0, "max_distance_px": 999}),
    ("filters.planes", {"max_hole_deg": 0, "contrast": 200, "min_area_deg2": 1, "min_share": 0.01}),
    ("fusion.vote", {"min_views": 1, "voxel_size": 0.1}),
]


@pytest.mark.parametrize(
    ("name", "settings"), [*VARIANTS, *(pytest.param(*sweep, marks=pytest.mark.slow) for sweep in SWEEPS)], ids=str
)
def test_no_setting_lets_a_stage_see_what_is_masked(name: str, settings: dict[str, Any]) -> None:
    size_hw = (128, 256) if settings.get("levels", 1) > 1 else (32, 64)
    contract_tests = [
        test for test in stage_contract_tests(name, settings=settings, size_hw=size_hw) if "masked" in str(test)
    ]
    assert len(contract_tests) == 1
    contract_tests[0].check()
    if Registry.installed().stages[name].output is not PointCloud:
        next(test for test in stage_contract_tests(name, settings=settings) if "respects masks" in str(test)).check()


def seen_in(capture: TinyCapture, rays: NDArray[np.float64], name: str) -> NDArray[np.bool_]:
    """Return which rays of a camera, (N, 3), end in a pixel that is not masked, or is beside one."""
    valid = capture.images[name].load_mask()
    near = np.logical_or.reduce([np.roll(valid, step, axis=(0, 1)) for step in ((0, 0), (0, 1), (0, -1), (1, 0))])
    columns, rows = np.floor(pixel_from_ray(rays, valid.shape)).astype(int).T
    return np.asarray(near[np.minimum(rows, len(valid) - 1), columns % valid.shape[1]])


def everywhere(capture: TinyCapture, name: str) -> RangeMap:
    ranges = capture.ranges[capture.names.index(name)]
    return RangeMap(ranges, np.full(ranges.shape, 200, np.uint8))


@pytest.mark.parametrize("min_views", [1, 2])
def test_no_point_of_a_cloud_comes_from_a_masked_pixel(tmp_path: Path, min_views: int) -> None:
    """Though the range maps have ranges there: a plugin may have put them."""
    capture = tiny_capture(Variant((64, 128), masked=True))
    ranges = {name: everywhere(capture, name) for name in capture.names}
    poses = {name: Pose(pose) for name, pose in zip(capture.names, capture.poses, strict=True)}
    params = FusionParams.model_validate(
        {"min_views": min_views, "merge_within": 0.0, "min_support": None, "even_density": False}
    )
    cloud = vote(ranges, poses, capture.images, params, Context(np.random.default_rng(0), tmp_path, 1))
    assert len(cloud) > 1000
    points = cloud.points_in_world.astype(np.float64)
    views = [seen_in(capture, poses[name].cam_from_world.apply(points), name) for name in capture.names]
    assert (np.sum(views, axis=0) >= min_views).all()


def test_no_key_point_of_colmap_is_masked(tmp_path: Path) -> None:
    capture = tiny_capture(Variant((96, 192), masked=True))
    pictures = ((name, image.load(), image.load_mask()) for name, image in capture.images.items())
    features, _ = colmap_sift(pictures, rng=np.random.default_rng(0), scratch=tmp_path)
    assert sum(len(found) for found in features.values()) > 100
    for name, found in features.items():
        columns, rows = np.floor(pixel_from_ray(found.bearings, (96, 192))).astype(int).T
        assert capture.images[name].load_mask()[rows, columns].all()


@pytest.mark.parametrize(("blank", "why"), [(True, "no view has any range"), (False, "at no pixel did 4 views agree")])
def test_an_empty_cloud_is_told(tmp_path: Path, blank: bool, why: str) -> None:
    capture = tiny_capture(Variant(blank=blank))
    poses = {name: Pose(pose) for name, pose in zip(capture.names, capture.poses, strict=True)}
    ranges = {name: capture.each(RangeMap)[name] for name in capture.names}
    if not blank:  # ranges that nobody else confirms
        ranges = {
            name: RangeMap(ranges[name].range * (3.0**idx), ranges[name].confidence)
            for idx, name in enumerate(capture.names)
        }
    context = Context(np.random.default_rng(0), tmp_path, 1)
    assert not len(
        vote(ranges, poses, capture.images, FusionParams.model_validate({"min_views": 4, "min_support": None}), context)
    )
    assert why in context.notes[0]
