"""Plain surfaces are refined again from filtered ranges; everything else keeps its ranges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.patchmatch.second_round import plain_and_changed, refine_plain_surfaces
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map

SIZE = (64, 128)
Views = tuple[list[NDArray[np.uint8]], NDArray[np.float32], list[Rigid3]]


@pytest.fixture(scope="module")
def views() -> Views:
    """Faint pictures of the room, its true ranges in the first view, and the poses of the others."""
    poses = capture_poses(3, seed=2, spread=0.4)
    rendered = [render(default_room(), pose, SIZE) for pose in poses]
    faint = [np.rint(100 + 0.06 * picture.astype(float)).astype(np.uint8) for picture, _ in rendered]
    return faint, rendered[0][1], [pose @ poses[0].inverse() for pose in poses[1:]]


def again(
    views: Views, range_map: RangeMap, filtered: RangeMap, *, reference: NDArray[np.uint8] | None = None
) -> tuple[RangeMap, float]:
    pictures, _, poses = views
    masks = [np.ones(SIZE, np.bool_) for _ in poses]
    settings: dict[str, Any] = {"source_from_reference": poses, "source_masks": masks, "halvings": 0, "rounds": 2}
    first = pictures[0] if reference is None else reference
    return refine_plain_surfaces(range_map, filtered, first, sources=pictures[1:], **settings)


def test_plain_surfaces_start_from_the_filtered_ranges(views: Views) -> None:
    truth = views[1]
    swept, filtered = as_map(1.3 * truth), as_map(1.03 * truth, TRUSTED)
    found, share = again(views, swept, filtered)
    found.check()
    assert share == 1
    assert np.median(np.abs(found.range / truth - 1)) < 0.02
    assert (found.confidence == SEEN).all()
    assert found.normals_in_cam is not None


def test_pixels_with_texture_keep_their_ranges(views: Views) -> None:
    truth = views[1]
    reference = views[0][0].copy()
    reference[:, 40:50:2] = 255
    textured = has_texture(reference)
    assert 0.05 < textured.mean() < 0.2
    found, share = again(views, as_map(1.3 * truth), as_map(truth), reference=reference)
    np.testing.assert_array_equal(found.range[textured], (1.3 * truth).astype(np.float32)[textured])
    assert (found.range != 1.3 * truth)[~textured].all()
    assert share == pytest.approx(1 - textured.mean())


def test_pixels_that_filters_did_not_change_or_that_were_not_seen_stay(views: Views) -> None:
    truth = views[1]
    changed = np.arange(SIZE[1]) < 64
    confidence = np.where(np.arange(SIZE[0]) < 32, SEEN, 40)[:, None] * np.ones(SIZE[1], int)
    swept = as_map(1.3 * truth, confidence)
    filtered = as_map(np.where(changed, truth, swept.range))
    chosen = plain_and_changed(swept, filtered, views[0][0])
    np.testing.assert_array_equal(chosen, changed & (confidence == SEEN))
    found = again(views, swept, filtered)[0]
    np.testing.assert_array_equal(found.range[~chosen], swept.range[~chosen])


def test_the_sky_of_the_filtered_map_loses_its_ranges(views: Views) -> None:
    truth = views[1]
    sky = np.zeros(SIZE, np.bool_)
    sky[:8] = True
    filtered = as_map(np.where(sky, np.nan, truth))
    found = again(views, as_map(1.3 * truth), RangeMap(filtered.range, filtered.confidence, sky=sky))[0]
    found.check()
    np.testing.assert_array_equal(found.valid, ~sky)
    assert found.sky is not None
    assert found.sky.sum() == sky.sum()


def test_range_maps_of_two_sizes_are_refused(views: Views) -> None:
    with pytest.raises(UsageError, match="must have one size"):
        again(views, as_map(views[1]), as_map(views[1][:32]))
