"""A cropped panorama gives what the whole one gives, wherever both see."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid
from pano_mvs.scene import Features, FilePart, Panorama
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.masking import Crop
from pano_mvs.testing.room import default_room, render

SIZE_HW = (128, 256)
CROPS = {"without poles": (0, 16, 256, 96), "narrow": (32, 20, 180, 88), "off the middle": (5, 40, 251, 77)}
MARGIN_PX = 16

Views = list[tuple[NDArray[np.uint8], NDArray[np.float32], Rigid3]]


@pytest.fixture(scope="module")
def views() -> Views:
    """Three pictures that look the same way, their true ranges, and their poses."""
    centers = np.array([(0.0, 0.0, 0.0), (0.3, 0.05, 0.0), (-0.1, -0.05, 0.35)])
    poses = [Rigid3.from_center(np.eye(3), center) for center in centers]
    return [(*render(default_room(), pose, SIZE_HW, supersample=1), pose) for pose in poses]


def panorama(folder: Path, picture: NDArray[np.uint8], crop: tuple[int, int, int, int] | None) -> Panorama:
    left, top, width, height = crop or (0, 0, SIZE_HW[1], SIZE_HW[0])
    path = folder / f"{len(list(folder.iterdir()))}.png"
    write_png(path, np.ascontiguousarray(picture[top : top + height, left : left + width]))
    return Panorama(FilePart(path), SIZE_HW, SIZE_HW, crop)


def swept(panoramas: list[Panorama], poses: list[Rigid3], settings: SweepSettings) -> NDArray[np.float32]:
    return sweep_range(
        panoramas[0].load(),
        [source.load() for source in panoramas[1:]],
        [pose @ poses[0].inverse() for pose in poses[1:]],
        near=0.5,
        far=8,
        settings=settings,
        reference_mask=panoramas[0].load_mask(),
        source_masks=[source.load_mask() for source in panoramas[1:]],
    ).range


def inside(pixels: NDArray[np.float64], crop: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    left, top, width, height = crop
    rows = (pixels[..., 1] >= top + MARGIN_PX) & (pixels[..., 1] <= top + height - MARGIN_PX)
    columns = (pixels[..., 0] >= left + MARGIN_PX) & (pixels[..., 0] <= left + width - MARGIN_PX)
    return np.asarray(rows & (columns | (width == SIZE_HW[1])))


@pytest.mark.parametrize("cost", ["sad", *(pytest.param(cost, marks=pytest.mark.slow) for cost in ("census", "zncc"))])
@pytest.mark.parametrize("crop", CROPS.values(), ids=list(CROPS))
@pytest.mark.parametrize("cropped_sources", [False, True], ids=["reference", "all"])
def test_ranges_are_those_of_the_whole_panorama(
    tmp_path: Path, views: Views, cost: str, crop: Crop, cropped_sources: bool
) -> None:
    settings = SweepSettings(planes=32, cost=cost, aggregation="box")
    pictures, truths, poses = zip(*views, strict=True)
    whole = swept([panorama(tmp_path, picture, None) for picture in pictures], list(poses), settings)
    parts = [panorama(tmp_path, p, crop if not idx or cropped_sources else None) for idx, p in enumerate(pictures)]
    part = swept(parts, list(poses), settings)
    rays = ray_grid(SIZE_HW)
    seen = inside(pixel_from_ray(rays, SIZE_HW), crop)
    assert np.isnan(part[~parts[0].load_mask()]).all()
    if cropped_sources:
        for pose in poses[1:]:
            points = (pose @ poses[0].inverse()).apply(rays * truths[0][..., None])
            seen &= inside(pixel_from_ray(points, SIZE_HW), crop)
    assert seen.mean() > 0.1
    with np.errstate(invalid="ignore"):
        same = (np.abs(part / whole - 1) < 1e-3) | (np.isnan(part) & np.isnan(whole))
    assert same[seen].mean() >= 0.99, same[seen].mean()


@pytest.mark.parametrize(("extract", "clear_px"), [(extract_sift, 2), (extract_orb, 12), (extract_sphorb, 15)])
def test_key_points_are_those_of_the_whole_panorama(
    tmp_path: Path, views: Views, extract: Callable[..., Any], clear_px: int
) -> None:
    """None is on the edge of the crop, and nearly all small ones that lie well inside are found again."""
    picture, (left, top, width, height) = views[0][0], CROPS["narrow"]
    part, whole = (panorama(tmp_path, picture, crop) for crop in (CROPS["narrow"], None))
    found, wanted = (extract(shown.load(), shown.load_mask(), max_keypoints=4000) for shown in (part, whole))
    assert clear_of(found, (left, top, width, height)).min() > clear_px
    small = wanted.sizes_rad < np.quantile(wanted.sizes_rad, 0.6)
    inner = small & (clear_of(wanted, (left, top, width, height)) > 32)
    nearest = (wanted.bearings[inner] @ found.bearings.T).max(axis=1)
    assert inner.sum() > 20
    assert (nearest > np.cos(0.1 * np.pi / SIZE_HW[0])).mean() > 0.9


def clear_of(found: Features, crop: tuple[int, int, int, int]) -> NDArray[np.float64]:
    """Return how many pixels within a crop each key point lies, (N,); negative outside."""
    pixels, (left, top, width, height) = pixel_from_ray(found.bearings, SIZE_HW), crop
    sides = np.minimum(pixels - (left, top), (left + width, top + height) - pixels)
    return np.asarray(sides.min(axis=1), np.float64)
