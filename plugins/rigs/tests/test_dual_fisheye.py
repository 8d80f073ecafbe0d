"""source.dual_fisheye: panoramas that know their lenses, from files in each layout, or a clear refusal."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from pano_mvs_rigs.source import DualFisheyeParams, dual_fisheye, list_captures, stitching_memory_bytes

from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.io.rig_calibration import calibration_text
from pano_mvs.scene import Panorama
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.stages.exports.colmap import ModelParams, colmap
from pano_mvs.stages.exports.colmap_lenses import colmap_lenses, lens_mask
from pano_mvs.stages.poses import RefineParams, refine
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.algorithms.poses.rig_capture import rig_capture
from tests.cli.conftest import Command
from tests.synthetic.fisheye_rig import Layout, example_rig, write_rig_capture
from tests.synthetic.rig_images import tiny_rig, tiny_rig_capture, tiny_rig_panorama

LAYOUTS: tuple[Layout, ...] = ("side_by_side", "folders", "suffixes")


def params(folder: Path, **more: Any) -> DualFisheyeParams:
    return DualFisheyeParams.model_validate(
        {"path": folder / "images", "calibration": folder / "rig.yaml", "width": 64} | more
    )


def stitched(settings: DualFisheyeParams, tmp_path: Path) -> dict[str, Panorama]:
    found = {}
    for idx, item in enumerate(list_captures(settings)):
        context = Context(np.random.default_rng(0), tmp_path / f"scratch{idx}")
        context.scratch.mkdir()
        found[item.name] = dual_fisheye(item=item, params=settings, ctx=context)
        found[item.name].check()
        assert context.metrics["lens_distance_m"] == pytest.approx(0.03)
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_gives_the_same_panoramas_with_their_rig(tmp_path: Path, layout: Layout) -> None:
    found = stitched(params(tiny_rig_capture(layout)), tmp_path)
    assert list(found) == ["000.png", "001.png"]
    panorama = found["000.png"]
    assert panorama.size_hw == (32, 64)
    assert panorama.load_mask().all()
    # The poses of rig.yaml may differ in their last bits, and OpenCV looks places up in steps of 1/32 pixel.
    assert np.abs(panorama.load().astype(int) - tiny_rig_panorama().load()).mean() < 0.1
    assert panorama.rig is not None
    assert panorama.rig.centers == pytest.approx(tiny_rig().centers)
    assert panorama.rig.stitch_distance_m == 3.0
    stored = {**panorama.to_parts()}
    again = Panorama.from_parts({**stored, "meta": json.loads(json.dumps(stored["meta"]))})
    assert again.rig is not None
    assert again.rig.to_values() == panorama.rig.to_values()
    assert (again.second_lens is None) == (layout == "side_by_side")


def test_files_of_insta360_cameras_are_jpeg(tmp_path: Path) -> None:
    shutil.copytree(tiny_rig_capture(), tmp_path, dirs_exist_ok=True)
    for path in sorted((tmp_path / "images").iterdir()):
        picture = cv2.imread(str(path))
        assert picture is not None
        path.with_suffix(".insp").write_bytes(bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 99])[1]))
        path.unlink()
    panorama = stitched(params(tmp_path), tmp_path)["000.png"]
    assert np.abs(panorama.load().astype(int) - tiny_rig_panorama().load()).mean() < 3


def test_the_panorama_shows_the_room(tmp_path: Path) -> None:
    room, pose = default_room(texture="weak"), capture_poses(2)[1]
    expected, _ = render(room, pose, (32, 64))
    picture = stitched(params(tiny_rig_capture()), tmp_path)["001.png"].load()
    assert np.abs(picture.astype(int) - expected).mean() < 6


def test_what_no_lens_sees_is_masked(tmp_path: Path) -> None:
    rig = example_rig(size_px=48, field_of_view_deg=160.0)
    write_rig_capture(tmp_path, default_room(texture="weak"), capture_poses(2), rig=rig, supersample=1)
    panorama = stitched(params(tmp_path, nadir_deg=10), tmp_path)["000.png"]
    valid = panorama.load_mask()
    assert 0.6 < valid.mean() < 0.9
    assert valid[16, 32]
    assert valid[16, 0]
    assert not valid[16, 16]
    assert not valid[31].any()


def test_the_width_is_that_of_the_lenses_unless_it_is_given_or_limited(tmp_path: Path) -> None:
    widths = []
    settings: list[dict[str, Any]] = [{"width": None}, {"width": None, "max_width": 50}, {"width": 100}]
    for number, more in enumerate(settings):
        (tmp_path / str(number)).mkdir()
        found = stitched(params(tiny_rig_capture(), **more), tmp_path / str(number))
        widths.append(found["000.png"].size_hw[1])
    assert widths == [round(2 * np.pi * 0.27 * 48) // 4 * 4, 48, 100]


def test_without_calibration_the_source_points_to_the_remedies() -> None:
    with pytest.raises(
        InputError, match=r"pano-mvs calibrate .*images --out rig\.yaml.*docs/rigs\.md.*camera maker's program"
    ):
        list(list_captures(params(tiny_rig_capture(), calibration=None)))


def test_one_capture_is_not_enough(tmp_path: Path) -> None:
    for name in ("front/1.png", "back/1.png", "back/2.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(tmp_path / "images" / name, np.zeros((48, 48, 3), np.uint8))
    (tmp_path / "rig.yaml").write_text(calibration_text(tiny_rig()))
    with pytest.raises(InputError, match=r"1 complete captures .*2\.png: the picture of the lens front is missing"):
        list(list_captures(params(tmp_path)))


def test_pictures_of_another_mode_of_the_camera_are_refused(tmp_path: Path) -> None:
    for name in ("1.png", "2.png"):
        (tmp_path / "images").mkdir(exist_ok=True)
        write_png(tmp_path / "images" / name, np.zeros((50, 100, 3), np.uint8))
    (tmp_path / "rig.yaml").write_text(calibration_text(tiny_rig()))
    with pytest.raises(
        InputError, match=r"1\.png: 100×50 px, but rig\.yaml is for 96×48 px \(both lenses side by side"
    ):
        stitched(params(tmp_path), tmp_path)


def test_memory_is_that_of_the_files_and_the_panorama() -> None:
    settings = params(tiny_rig_capture("folders"), width=None, max_width=8192)
    item = next(iter(list_captures(settings)))
    assert 3e8 < stitching_memory_bytes(settings, {"item": item}) < 1e9
    assert stitching_memory_bytes(params(tiny_rig_capture("folders"), max_megapixels=0.001), {"item": item}) == 0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_pictures_of_the_rig_are_exported_unchanged(tmp_path: Path, layout: Layout) -> None:
    panorama = stitched(params(tiny_rig_capture(layout)), tmp_path)["000.png"]
    context = Context(np.random.default_rng(0), tmp_path)
    files = colmap_lenses(image=panorama, ctx=context).files
    originals = tiny_rig_capture("folders") / "images"
    for lens in ("front", "back"):
        exported = decode_image(files[f"colmap_rig/images/{lens}/{{item}}.png"])
        assert np.array_equal(exported, decode_image(originals / lens / "000.png"))
        mask = cv2.imread(str(files[f"colmap_rig/masks/{lens}/{{item}}.png.png"]), cv2.IMREAD_GRAYSCALE)
        assert (exported[mask == 0] == 0).all()
    labels = cv2.imread(str(files["colmap_rig/labels/{item}.png"]), cv2.IMREAD_GRAYSCALE)
    assert labels is not None
    assert labels.shape == (32, 64)
    assert (labels[16, 32], labels[16, 0]) == (1, 2)


def test_a_mask_of_a_lens_is_its_field_of_view() -> None:
    lens = tiny_rig().lenses[0]
    mask = lens_mask(lens)
    radius_px = lens.focal_xy[0] * float(lens.radius_from_angle(lens.max_angle_rad))
    assert mask.shape == lens.size_hw
    assert (mask == 255).sum() == pytest.approx(np.pi * radius_px**2, rel=0.02)


def test_panoramas_without_a_rig_have_no_fisheye_pictures(tmp_path: Path) -> None:
    context = Context(np.random.default_rng(0), tmp_path)
    plain = replace(tiny_rig_panorama(), rig=None, first_lens=None)
    assert not colmap_lenses(image=plain, ctx=context).files
    assert any("not stitched by source.dual_fisheye" in note for note in context.notes)


@pytest.mark.parametrize("metric", [True, False])
def test_the_model_of_the_rig_is_written_if_the_poses_are_in_metres(tmp_path: Path, metric: bool) -> None:
    capture = rig_capture(noise_deg=0.0, points=50, count=3)
    images = {name: replace(tiny_rig_panorama(), rig=capture.rig) for name in capture.poses.names}
    context = Context(np.random.default_rng(0), tmp_path)
    poses = replace(capture.poses, metric=metric)
    files = colmap(poses=poses, images=images, photographs=None, params=ModelParams(), ctx=context).files
    assert ("colmap_rig/sparse/0/rigs.bin" in files) == metric
    assert "colmap/sparse/0/cameras.bin" in files
    if metric:
        model = pycolmap.Reconstruction(str(files["colmap_rig/sparse/0/rigs.bin"].parent))
        names = {image.name for image in model.images.values()}
        assert names == {f"{lens}/{number:03d}.png" for lens in ("front", "back") for number in range(3)}
    else:
        assert any("colmap_rig was not written" in note and "poses.scale" in note for note in context.notes)


@pytest.mark.parametrize(
    ("offset_m", "note"),
    [
        (0.05, "unit of length: metres, by the distance of 50 mm"),
        (0.0005, "does not determine the unit of length here"),
    ],
)
def test_refinement_reports_what_the_distance_of_the_lenses_gave(tmp_path: Path, offset_m: float, note: str) -> None:
    capture = rig_capture(offset_m=offset_m, points=150, count=4)
    images = {name: replace(tiny_rig_panorama(), rig=capture.rig) for name in capture.poses.names}
    context = Context(np.random.default_rng(0), tmp_path)
    refine(poses=capture.poses, images=images, params=RefineParams(align=False), ctx=context)
    assert any(note in text for text in context.notes)


RUN = """\
pano_mvs: 1
stages:
  images:   {use: source.dual_fisheye, path: images, calibration: rig.yaml}
  features: {use: features.sift_tangent, max_keypoints: 1200}
  pairs:    {use: pairs.exhaustive}
  matches:  {use: matches.brute_force}
  poses:    {use: poses.scaled_translation}
  refined:  {use: poses.refine}
  colmap:   {use: export.colmap}
  lenses:   {use: export.colmap_lenses}
"""


@pytest.mark.slow
def test_a_rendered_rig_becomes_a_metric_model_of_both_lenses(pano_mvs: Command, tmp_path: Path) -> None:
    rig = example_rig(size_px=300, offset_m=0.06)
    poses = capture_poses(4, spread=0.6, seed=3)
    write_rig_capture(tmp_path, default_room(), poses, rig=rig, layout="folders", supersample=1)
    (tmp_path / "run.yaml").write_text(RUN)
    result = pano_mvs("run", tmp_path / "run.yaml", "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    assert result.code == 0, result.text
    assert "metres, by the distance of 60 mm between the lens centres" in result.flat
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "colmap_rig" / "sparse" / "0"))
    assert model.num_images() == 8
    for image in model.images.values():
        assert (tmp_path / "out" / "colmap_rig" / "images" / image.name).read_bytes() == (
            tmp_path / "images" / image.name
        ).read_bytes()
    found = {image.name: image.projection_center() for image in model.images.values()}
    for first, second in ((0, 1), (0, 2), (1, 3)):
        distance = np.linalg.norm(found[f"front/{first:03d}.png"] - found[f"front/{second:03d}.png"])
        lens = rig.lens_from_rig[0]
        expected = np.linalg.norm((lens @ poses[first]).center - (lens @ poses[second]).center)
        assert distance == pytest.approx(expected, rel=0.01)
    assert model.compute_mean_reprojection_error() < 0.5
