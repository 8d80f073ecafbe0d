"""What one camera alone sees, in rooms where that is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.results.coverage import (
    LonelyArea,
    ViewCoverage,
    coverage,
    coverage_from_fact,
    coverage_key,
    fact_of,
    seen_alone,
    view_coverage,
)
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import RangeMap
from pano_mvs.testing.tiny_capture import TinyCapture

HALF = np.array([3.0, 1.5, 3.0])


def camera(x: float, z: float = 0.0) -> Rigid3:
    return Rigid3.from_center(np.eye(3), np.array([x, 0.0, z]))


def box_with_screen(pose: Rigid3, size_hw: tuple[int, int]) -> FloatArray:
    """Return ranges in a box with a wall at x = 0 from floor to ceiling that leaves a door at z > 1."""
    center, rays = pose.center, ray_grid(size_hw)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = (np.where(rays > 0, HALF, -HALF) - center) / rays
        ranges = np.nanmin(np.where(walls > 0, walls, np.inf), axis=-1)
        screen = -center[0] / rays[..., 0]
        z = center[2] + screen * rays[..., 2]
    return np.asarray(np.where((screen > 0) & (screen < ranges) & (z < 1), screen, ranges))


def test_behind_a_wall_a_camera_sees_alone() -> None:
    """The second camera stands in the other room: only what is seen through the door is common."""
    left, right = camera(-1.5), camera(1.5)
    others = [(box_with_screen(right, (64, 128)), right)]
    alone = seen_alone(box_with_screen(left, (32, 64)), left, others)
    rays = ray_grid((32, 64))
    points = left.center + rays * box_with_screen(left, (32, 64))[..., None]
    weights = np.broadcast_to(pixel_solid_angle((32, 64))[:, None], alone.shape) / (4 * np.pi)
    assert alone[points[..., 0] < -0.5].mean() > 0.8
    assert weights[alone].sum() > 0.6
    assert not alone[points[..., 0] > 0.5].any(), "the other room"
    assert not seen_alone(box_with_screen(left, (32, 64)), left, []).any(), "nobody to compare with"


def test_cameras_in_one_room_see_the_same() -> None:
    first, second = camera(-1.5), camera(-2.0, 1.0)
    others = [(box_with_screen(second, (64, 128)), second)]
    found = view_coverage(box_with_screen(first, (32, 64)), first, others)
    assert found.alone < 0.05
    assert found.areas == ()


def test_the_area_is_where_it_is() -> None:
    left, right = camera(-1.5), camera(1.5)
    third = camera(-1.5, 2.0)
    ranges = box_with_screen(left, (32, 64))
    found = view_coverage(ranges, left, [(box_with_screen(right, (64, 128)), right)])
    (area, *_) = found.areas
    assert area.share == pytest.approx(found.alone, abs=0.1)
    at = left.center + area.distance * np.array(
        [
            np.cos(np.deg2rad(area.elevation_deg)) * np.sin(np.deg2rad(area.azimuth_deg)),
            -np.sin(np.deg2rad(area.elevation_deg)),
            np.cos(np.deg2rad(area.elevation_deg)) * np.cos(np.deg2rad(area.azimuth_deg)),
        ]
    )
    assert area.at == pytest.approx(at)
    assert area.at[0] < 0, "in its own room"
    both = [(box_with_screen(right, (64, 128)), right), (box_with_screen(third, (64, 128)), third)]
    assert view_coverage(ranges, left, both).alone < 0.05, "a third camera sees it too"


def test_what_is_unknown_counts_as_seen() -> None:
    left, right = camera(-1.5), camera(1.5)
    unknown = np.full((64, 128), np.nan)
    assert view_coverage(box_with_screen(left, (32, 64)), left, [(unknown, right)]).alone == 0


def test_an_area_across_the_seam_is_one() -> None:
    """Two cameras back to back with a wall between them; the first looks away from it, so the area is cut in two."""
    left, right = camera(-1.5), camera(1.5)
    turned = Rigid3.from_center(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), left.center)
    rays = ray_grid((32, 64)) @ turned.rotation
    columns = np.round((np.arctan2(rays[..., 0], rays[..., 2]) / (2 * np.pi) + 0.5) * 64 - 0.5).astype(int) % 64
    ranges = np.take_along_axis(box_with_screen(left, (32, 64)), columns, axis=1)
    others = [(box_with_screen(right, (64, 128)), right)]
    straight = view_coverage(box_with_screen(left, (32, 64)), left, others)
    found = view_coverage(ranges, turned, others)
    assert found.areas[0].share == pytest.approx(straight.areas[0].share, rel=0.02)
    assert found.areas[0].at == pytest.approx(straight.areas[0].at, abs=0.3)


def test_the_typical_range_is_the_median_by_solid_angle() -> None:
    ranges = np.full((32, 64), 2.0)
    ranges[:8] = 50.0  # a quarter of the rows, but less than 15 % of the sphere
    ranges[20:] = 1.0
    assert view_coverage(ranges, camera(0), []).typical_range == 2.0
    ranges[10:] = np.nan
    assert view_coverage(ranges, camera(0), []).typical_range == 50.0


def test_stored_values_are_compared(results: StoredValues, tiny: TinyCapture) -> None:
    found = coverage(results, tiny.names)
    assert list(found) == list(tiny.names)
    for name, known in found.items():
        true = tiny.each(RangeMap)[name].range
        low, high = np.quantile(true[np.isfinite(true)], [0.25, 0.75])
        assert low < known.typical_range < high
        assert known.alone < 0.5
    assert list(coverage(results, tiny.names[:1])) == [tiny.names[0]]
    assert coverage(StoredValues(), tiny.names) == {}
    without = replace(results, refs={name: refs for name, refs in results.refs.items() if name != "ranges"})
    assert coverage(without, tiny.names) == {}


def test_the_key_changes_with_the_ranges(results: StoredValues, tiny: TinyCapture) -> None:
    assert results.store is not None
    ranges = dict(results.refs["ranges"]) | {tiny.names[0]: results.refs["ranges"][tiny.names[1]]}
    other = replace(results, refs={**results.refs, "ranges": ranges})
    keys = {coverage_key(results, tiny.names), coverage_key(other, tiny.names), coverage_key(results, tiny.names[:2])}
    assert len(keys) == 3


def test_figures_survive_a_page(results: StoredValues, tiny: TinyCapture) -> None:
    area = LonelyArea(1.0, -2.0, 0.1, 3.5, (1.0, 2.0, 3.0))
    found = {"a": ViewCoverage(2.5, 0.1, (area,)), **coverage(results, tiny.names)}
    assert coverage_from_fact(json.loads(json.dumps(fact_of(found)))) == found
