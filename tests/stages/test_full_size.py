"""Range maps grow to the size of the image files, in files of their own."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import FilePart, Panorama, Pose, RangeMap
from pano_mvs.scene.image_file import write_png
from pano_mvs.stages.depth import FullSizeParams, full_size, full_size_memory_bytes
from pano_mvs.stages.exports.files import RangesParams, ranges
from pano_mvs.testing.room import capture_poses, default_room, render

SIZE, FILE = (64, 128), (192, 384)


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> tuple[RangeMap, list[Panorama], list[Pose]]:
    """The range map of a panorama of 128 columns, three panoramas whose files have 384, and poses."""
    folder = tmp_path_factory.mktemp("full_size")
    poses = capture_poses(3, seed=1, spread=0.4)
    panoramas = []
    for number, pose in enumerate(poses):
        write_png(folder / f"{number}.png", render(default_room(), pose, FILE, supersample=1)[0])
        panoramas.append(Panorama(FilePart(folder / f"{number}.png"), SIZE, FILE, nadir_deg=20))
    truth = render(default_room(), poses[0], SIZE, supersample=1)[1]
    seen = panoramas[0].load_mask()
    given = RangeMap(np.where(seen, truth, np.float32(np.nan)), np.where(seen, np.uint8(200), np.uint8(0)))
    return given, panoramas, [Pose(pose) for pose in poses]


def context(folder: Path) -> Context:
    folder.mkdir(exist_ok=True)
    return Context(np.random.default_rng(0), folder)


def at_full_size(
    unit: tuple[RangeMap, list[Panorama], list[Pose]], folder: Path, params: FullSizeParams | None = None
) -> RangeMap:
    given, panoramas, poses = unit
    return full_size(
        given, panoramas[0], poses[0], panoramas[1:], poses[1:], params=params or FullSizeParams(), ctx=context(folder)
    )


@pytest.mark.slow
def test_ranges_have_the_size_of_the_file(unit: tuple[RangeMap, list[Panorama], list[Pose]], tmp_path: Path) -> None:
    found = at_full_size(unit, tmp_path)
    found.check()
    assert found.range.shape == FILE
    assert {path.name for path in tmp_path.iterdir()} == {"range", "confidence"}
    truth = render(default_room(), unit[2][0].cam_from_world, FILE, supersample=1)[1]
    assert np.nanmedian(np.abs(found.range / truth - 1)) < 0.01
    at_once = at_full_size(unit, tmp_path / "again", FullSizeParams(max_sources=1))
    np.testing.assert_array_equal(at_once.confidence, found.confidence)


def test_they_can_be_exported_with_the_masks_of_that_size(
    unit: tuple[RangeMap, list[Panorama], list[Pose]], tmp_path: Path
) -> None:
    found = at_full_size(unit, tmp_path / "found")
    files = ranges(found, unit[1][0], params=RangesParams(formats=("npy",)), ctx=context(tmp_path / "files"))
    written = np.load(files.files["range/{item}.npy"])
    mask = unit[1][0].at_width(FILE[1]).load_mask()
    np.testing.assert_array_equal(np.isfinite(written), found.valid & mask)


@pytest.mark.parametrize(("max_width", "rows"), [(128, 64), (256, 128), (16384, 192)])
def test_the_width_is_limited(
    unit: tuple[RangeMap, list[Panorama], list[Pose]], tmp_path: Path, max_width: int, rows: int
) -> None:
    found = at_full_size(unit, tmp_path, FullSizeParams(max_width=max_width, rounds=0))
    assert found.range.shape[0] == rows
    assert (found is unit[0]) == (rows == 64)


@pytest.mark.slow
def test_a_blurred_panorama_is_only_enlarged(unit: tuple[RangeMap, list[Panorama], list[Pose]], tmp_path: Path) -> None:
    """Pixels that were interpolated by whoever stitched it say nothing new; the sources are not even read."""
    given, panoramas, poses = unit
    given = RangeMap(
        given.range.repeat(8, axis=0).repeat(8, axis=1), given.confidence.repeat(8, axis=0).repeat(8, axis=1)
    )
    small = render(default_room(), poses[0].cam_from_world, (256, 512), supersample=1)[0]
    write_png(tmp_path / "blurred.png", np.asarray(cv2.resize(small, (2048, 1024)), np.uint8))
    blurred = Panorama(FilePart(tmp_path / "blurred.png"), SIZE, (1024, 2048), nadir_deg=20)
    missing = [Panorama(FilePart(tmp_path / "missing.png"), SIZE, (1024, 2048)) for _ in panoramas[1:]]
    params = FullSizeParams()
    found = full_size(given, blurred, poses[0], missing, poses[1:], params=params, ctx=context(tmp_path / "stage"))
    assert found.range.shape == (1024, 2048)
    assert np.nanmax(np.abs(found.range / given.range.repeat(2, axis=0).repeat(2, axis=1) - 1)) < 0.03


@pytest.mark.slow
def test_what_a_mask_hides_changes_nothing(unit: tuple[RangeMap, list[Panorama], list[Pose]], tmp_path: Path) -> None:
    given, panoramas, poses = unit
    painted = []
    for number, panorama in enumerate(panoramas):
        picture = panorama.at_width(FILE[1]).load_unmasked()
        picture[~panorama.at_width(FILE[1]).load_mask()] = (255, 0, 0)
        write_png(tmp_path / f"{number}.png", picture)
        painted.append(Panorama(FilePart(tmp_path / f"{number}.png"), SIZE, FILE, nadir_deg=20))
    first, second = (
        at_full_size((given, some, poses), tmp_path / name)
        for some, name in ((panoramas, "first"), (painted, "second"))
    )
    np.testing.assert_array_equal(first.range, second.range)


def test_a_picture_of_16384_columns_takes_less_than_3_gb() -> None:
    panoramas = [Panorama(FilePart(Path("x.jpg")), (2048, 4096), (8192, 16384)) for _ in range(9)]
    inputs = {"ref": panoramas[0], "sources": panoramas[1:]}
    needed = full_size_memory_bytes(FullSizeParams(), inputs)
    assert 2e9 < needed < 3e9
    assert needed - full_size_memory_bytes(FullSizeParams(max_sources=2), inputs) > 2 * 2 * 8192 * 16384
