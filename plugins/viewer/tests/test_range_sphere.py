"""Inside a camera, ranges are marked as in previews: weak ones pale, filled ones striped, missing ones grey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_viewer.actors import range_panorama
from pano_mvs_viewer.controller import Tour
from pano_mvs_viewer.shown_scene import ShownCamera, open_scene
from pano_mvs_viewer.view import quiet_vtk, require_drawing
from pano_mvs_viewer.viewpoint import box_of
from pano_mvs_viewer.window import SceneWindow

from pano_mvs.io.images.preview import color_mapped, range_limits
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from tests.synthetic.viewed_scenes import turned_poses, write_output

SIZE_HW = (64, 128)
# Columns of a camera's range map: consistent, weak, filled, no range.
QUARTERS = (200, 100, 30, 0)


def write_ranges(out: Path, *, confidence: bool = True) -> ShownCamera:
    """Write ranges of the first camera, a quarter of the columns of each kind, and return it."""
    ranges = np.broadcast_to(np.geomspace(1, 4, SIZE_HW[0])[:, None], SIZE_HW).astype(np.float32)
    levels = np.repeat(np.array(QUARTERS, np.uint8), SIZE_HW[1] // 4)[None].repeat(SIZE_HW[0], axis=0)
    camera = open_scene(out).cameras[0]
    files = out / "range" / f"{camera.name}.tiff", out / "confidence" / f"{camera.name}.png"
    for file in files:
        file.parent.mkdir(parents=True)
    write_range_tiff(files[0], np.where(levels > 0, ranges, np.float32(np.nan)))
    if confidence:
        write_confidence_png(files[1], levels)
    return open_scene(out).cameras[0]


def test_unconfirmed_ranges_are_marked_and_explained(tmp_path: Path) -> None:
    camera = write_ranges(write_output(tmp_path, turned_poses(2), points=0))
    picture, legend = range_panorama(camera, "m")
    assert picture is not None
    ranges = np.geomspace(1, 4, SIZE_HW[0]).astype(np.float32)[:, None].repeat(SIZE_HW[1], axis=1)
    ranges[:, 96:] = np.nan
    plain = color_mapped(ranges, *range_limits(ranges)).astype(int)
    np.testing.assert_array_equal(picture[:, :32], plain[:, :32])
    assert (picture[:, 32:64] > plain[:, 32:64]).any(axis=-1).all()  # pale
    stripes = (picture[:, 64:96] == 255).all(axis=-1)
    assert 0.3 < stripes.mean() < 0.5
    assert (picture[:, 96:] == 128).all()
    assert legend.split("\n") == [
        "ranges: red 1.000 m to blue 4.000 m",
        "pale: not confirmed by other views",
        "striped: filled in, not seen",
        "grey: no range",
    ]


def test_without_confidences_nothing_is_marked(tmp_path: Path) -> None:
    camera = write_ranges(write_output(tmp_path, turned_poses(2), points=0), confidence=False)
    assert "pale" not in range_panorama(camera, "m")[1]


def test_a_camera_without_ranges_says_so(tmp_path: Path) -> None:
    out = write_output(tmp_path, turned_poses(2), points=0)
    camera = open_scene(out).cameras[0]
    assert range_panorama(camera, "m") == (
        None,
        "no ranges of this camera: the workflow has no export.ranges, or the run did not reach it",
    )
    broken = tmp_path / "broken.tiff"
    broken.write_bytes(b"II*")
    picture, reason = range_panorama(replace(camera, range_file=broken), "m")
    assert picture is None
    assert "broken.tiff" in reason


def test_the_window_shows_ranges_instead_of_the_panorama(tmp_path: Path) -> None:
    require_drawing()  # else VTK takes the tests down with it
    quiet_vtk()
    out = write_output(tmp_path, turned_poses(2), points=0)
    write_ranges(out)
    scene = open_scene(out)
    tour = Tour(scene, None, box_of(np.zeros((0, 3)), scene.centers))
    tour.see("inside:000")
    tour.key("k")
    window = SceneWindow(tour, size_wh=(300, 200), off_screen=True)
    try:
        panorama = window.picture()
        tour.key("r")
        window.update()
        shown = window.picture()
        # All rays of the left quarter of a window are those of a camera with a range map of the same size.
        colors, _ = range_panorama(scene.cameras[0], "m")
        assert colors is not None
        for x, y in ((60, 60), (150, 100), (240, 60)):
            along = scene.cameras[0].cam_from_world.rotation @ tour.state.viewpoint.ray(x, y, (300, 200))[1]
            column = int((np.arctan2(along[0], along[2]) / (2 * np.pi) + 0.5) * SIZE_HW[1])
            row = int((np.arcsin(along[1]) / np.pi + 0.5) * SIZE_HW[0])
            around = colors[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4].reshape(-1, 3).astype(int)
            assert np.abs(around - shown[y, x]).max(axis=-1).min() < 40
        assert "pale" in window._range_legend
        tour.key("r")
        window.update()
        assert window._range_legend == ""
        assert np.abs(window.picture().astype(int) - panorama).mean() < 1
        assert np.abs(shown.astype(int) - panorama).mean() > 10
    finally:
        window.close()


@pytest.mark.parametrize(
    ("level", "name"), [(0, "no range"), (63, "filled"), (64, "seen but weak"), (128, "consistent")]
)
def test_confidences_have_names(level: int, name: str) -> None:
    from pano_mvs.scene.range_map import confidence_name

    assert confidence_name(level) == name
