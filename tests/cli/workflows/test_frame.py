"""The frame and the scale of a result, also of known poses."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.geometry.geodesy import lla_from_local
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from tests.algorithms.poses.synthetic_capture import random_rotation
from tests.cli.conftest import SMALL, Command, run_json
from tests.docs.pages import block
from tests.io.images.pictures import app1, exif, full_sphere, xmp
from tests.stored import read_picture

UP = np.array([0.0, -1.0, 0.0])

KNOWN = """
pano_mvs: 1
stages:
  images:   {use: source.folder, path: capture/images}
  known:    {use: poses.from_model, path: known.json}
"""


def true_poses(capture: Path) -> dict[str, Rigid3]:
    poses = read_poses(capture / "truth" / "poses.json")
    return {Path(name).name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


def write_known(path: Path, poses: dict[str, Rigid3]) -> None:
    views = [{"image": n, "R": p.rotation.tolist(), "t": p.translation.tolist()} for n, p in poses.items()]
    path.write_text(json.dumps({"metric": False, "views": views}))


def write_sensors(picture: Path, up_in_cam: np.ndarray) -> None:
    """Put the pitch and roll of a camera into its picture: up = (−sin r, −cos p cos r, sin p cos r)."""
    roll = np.rad2deg(-np.arcsin(up_in_cam[0]))
    pitch = np.rad2deg(np.arctan2(up_in_cam[2], -up_in_cam[1]))
    data = picture.read_bytes()
    width, height = struct.unpack_from(">II", data, 16)
    packet = xmp(full_sphere(height, width, PosePitchDegrees=pitch, PoseRollDegrees=roll))
    insert_chunk(picture, b"iTXt" + b"XML:com.adobe.xmp\0\0\0\0\0" + packet)


def write_gps(picture: Path, position_lla: np.ndarray) -> None:
    """Put a position into a picture, to a millimetre."""
    latitude, longitude = (
        ((int(angle), 1), (0, 1), (round((angle % 1) * 3600e6), 10**6)) for angle in position_lla[:2]
    )
    altitude = (round(position_lla[2] * 1000), 1000)
    insert_chunk(picture, b"eXIf" + exif(latitude=latitude, longitude=longitude, altitude=altitude))


def insert_chunk(picture: Path, chunk: bytes) -> None:
    """Put a chunk of a PNG, its type included, behind the header."""
    data = picture.read_bytes()
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    picture.write_bytes(data[:33] + whole + data[33:])


@pytest.mark.slow
def test_a_known_baseline_makes_everything_metric(pano_mvs: Command, capture: Path) -> None:
    truth = true_poses(capture)
    baseline = float(np.linalg.norm(truth["002.png"].center - truth["000.png"].center))
    work = capture.parent
    page = block("frames_and_scale.md", "workflow").replace("hall.jpg", "000.png").replace("kitchen.jpg", "002.png")
    (work / "metres.yaml").write_text(page.replace("metres: 1.2", f"metres: {baseline:.6f}"))
    run = ("run", work / "metres.yaml", "--images", capture / "images", "--out", "out", *SMALL)
    result = pano_mvs(*run)
    assert result.code == 0, result.text
    told = run_json(Path("out"))["poses"]
    assert told["metric"] is True
    assert told["scale"] == f"metres, by the baseline of {baseline:.6g} m from 000.png to 002.png"
    assert told["frame"].startswith("origin at the first registered camera; y down along gravity, by ")
    np.testing.assert_array_equal(told["centers"][0], 0)
    ranges = {name: read_range_tiff(Path("out") / f"range/{name}.tiff") for name in ("000", "001", "002", "003")}
    with np.load(capture / "truth" / "depth.npz") as file:
        depths = dict(file)
    for name, estimate in ranges.items():
        ratios = (estimate / depths[name])[np.isfinite(estimate) & np.isfinite(depths[name])]
        assert np.median(ratios) == pytest.approx(1, abs=0.03), name
    model = pycolmap.Reconstruction("out/colmap/sparse/0")
    centers = {image.name: image.projection_center() for image in model.images.values()}
    assert np.linalg.norm(centers["002.png"] - centers["000.png"]) == pytest.approx(baseline, rel=1e-5)
    # The room's floor is level, whichever way the first camera was held.
    points = np.array([point.xyz for point in model.points3D.values()])
    ups = np.array(
        [
            image.cam_from_world().rotation.matrix().T @ truth[image.name].rotation @ UP
            for image in model.images.values()
        ]
    )
    assert np.rad2deg(np.arccos(-ups[:, 1])).max() < 1.0
    assert len(points) > 50
    again = pano_mvs(*run)
    assert "0 units computed" in again.text


@pytest.fixture
def turned(capture: Path) -> dict[str, Rigid3]:
    """The rendered capture in a world that is turned and in another unit, as known.json; returns the true poses."""
    truth = true_poses(capture)
    moved = Similarity3(0.5, random_rotation(np.random.default_rng(3)), np.array([1.0, 2.0, 3.0]))
    write_known(capture.parent / "known.json", {name: moved.move_camera(pose) for name, pose in truth.items()})
    return truth


def test_sensors_level_a_turned_world(pano_mvs: Command, capture: Path, turned: dict[str, Rigid3]) -> None:
    for name, pose in turned.items():
        write_sensors(capture / "images" / name, pose.rotation @ UP)
    workflow = capture.parent / "level.yaml"
    stages = "  level: {use: poses.level, evidence: sensors}\n  twice: {use: poses.scale, factor: 2}\n"
    workflow.write_text(KNOWN + stages)
    result = pano_mvs("run", workflow, "--out", "out")
    assert result.code == 0, result.text
    told = run_json(Path("out"))["poses"]
    assert "the pitch and roll that 4 of 4 panoramas state, median disagreement 0.00°" in told["frame"]
    assert told["scale"] == "metres, by the given factor 2"
    heights = [-pose.center[1] for pose in turned.values()]
    np.testing.assert_allclose(-np.array(told["centers"])[:, 1], np.array(heights) - heights[0], atol=1e-6)


def test_pitch_and_roll_that_fit_no_picture_are_named(
    pano_mvs: Command, capture: Path, turned: dict[str, Rigid3]
) -> None:
    for name in turned:
        write_sensors(capture / "images" / name, np.array([0.2, -0.9, 0.28]) / np.linalg.norm([0.2, -0.9, 0.28]))
    workflow = capture.parent / "level.yaml"
    workflow.write_text(KNOWN + "  level: {use: poses.level}\n")
    assert pano_mvs("run", workflow, "--out", "out").code == 0
    (note,) = [note for note in run_json(Path("out"))["notes"] if "pitch and roll in the metadata" in note]
    assert "were not used: the sensors of 4 panoramas disagree by" in note


def test_gps_gives_metres_and_the_compass(pano_mvs: Command, capture: Path, turned: dict[str, Rigid3]) -> None:
    """The room as a street: 60 m for each of its units, x to the east and z to the north."""
    for name, pose in turned.items():
        write_sensors(capture / "images" / name, pose.rotation @ UP)
        write_gps(capture / "images" / name, lla_from_local(60 * pose.center, [47.5, 8.25, 410.0]))
    workflow = capture.parent / "gps.yaml"
    workflow.write_text(KNOWN + "  metres: {use: poses.scale, gps: true, align: gps, gps_noise_m: 0.5}\n")
    result = pano_mvs("run", workflow, "--out", "out")
    assert result.code == 0, result.text
    told = run_json(Path("out"))["poses"]
    assert told["metric"] is True
    assert told["scale"].startswith("metres, by GPS of 4 of 4 panoramas")
    assert told["frame"] == (
        "x east, y down, z north, by GPS; origin at the first registered camera (47.5000000°, 8.2500000°, 410.0 m)"
    )
    np.testing.assert_allclose(told["centers"], [60 * pose.center for pose in turned.values()], atol=0.01)
    indoors = pano_mvs("run", workflow, "--out", "out", "--set", "metres.gps_noise_m=20")
    assert indoors.code != 0
    assert "too close for positions that are good to 20.0 m" in indoors.flat


def test_what_gives_no_scale_stops_with_the_reason(pano_mvs: Command, capture: Path, turned: dict[str, Rigid3]) -> None:
    workflow = capture.parent / "scale.yaml"
    for settings, reason in (
        ("gps: true, vertical: world", "0 of 4 registered panoramas have a GPS position; 3 are needed"),
        ("camera_height_m: 1.6, vertical: world", "only 0 sparse points lie below the cameras"),
        ("baseline: {from: 000.png, to: 7.png, metres: 1}", "7.png is not one image of the capture"),
        ("baseline: {from: '000', to: images/000.png, metres: 1}", "were taken in one place"),
    ):
        workflow.write_text(KNOWN + f"  scale: {{use: poses.scale, {settings}}}\n")
        result = pano_mvs("run", workflow, "--out", "out")
        assert result.code != 0
        assert reason in result.flat, result.text


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ("", "give exactly one of baseline"),
        (", factor: 2, gps: true", "give exactly one of baseline"),
        (", factor: 2, align: gps", "requires gps: true"),
        (", factor: -2", "greater than 0"),
        (", baseline: {from: a, metres: 1}", "'baseline.to' is missing"),
    ],
)
def test_settings_that_contradict_each_other_are_found_before_anything_runs(
    pano_mvs: Command, capture: Path, turned: dict[str, Rigid3], settings: str, problem: str
) -> None:
    workflow = capture.parent / "check.yaml"
    workflow.write_text(KNOWN + f"  scale: {{use: poses.scale{settings}}}\n")
    result = pano_mvs("check", workflow)
    assert result.code == 2
    assert problem in result.flat


@pytest.mark.slow
def test_cropped_photographs_alone_give_a_level_world_in_metres_and_north(pano_mvs: Command, capture: Path) -> None:
    """Nothing is known but the pictures: JPEGs without poles, with attributes for metadata; a unit is 60 m."""
    truth = true_poses(capture)
    for name, pose in truth.items():
        path = capture / "images" / name
        picture = read_picture(path)
        height, width = picture.shape[:2]
        edge = height // 10
        up = pose.rotation @ UP
        fields = full_sphere(
            height,
            width,
            CroppedAreaTopPixels=edge,
            CroppedAreaImageHeightPixels=height - 2 * edge,
            PosePitchDegrees=np.rad2deg(np.arctan2(up[2], -up[1])),
            PoseRollDegrees=np.rad2deg(-np.arcsin(up[0])),
        )
        latitude, longitude, altitude = lla_from_local(60 * pose.center, [-47.5, -8.25, 410.0])
        angles = [((int(abs(a)), 1), (0, 1), (round((abs(a) % 1) * 3600e6), 10**6)) for a in (latitude, longitude)]
        position = exif(
            ">", refs=(b"S", b"W", 0), latitude=angles[0], longitude=angles[1], altitude=(round(altitude * 1000), 1000)
        )
        data = bytes(cv2.imencode(".jpg", picture[edge : height - edge], [cv2.IMWRITE_JPEG_QUALITY, 97])[1])
        packet = b"http://ns.adobe.com/xap/1.0/\0" + xmp(fields, form="attribute")
        path.with_suffix(".JPG").write_bytes(data[:2] + app1(b"Exif\0\0" + position) + app1(packet) + data[2:])
        path.unlink()
    workflow = capture.parent / "alone.yaml"
    workflow.write_text(f"""
pano_mvs: 1
stages:
  images:   {{use: source.folder, path: {capture / "images"}}}
  features: {{use: features.sift_tangent, max_keypoints: 2000}}
  pairs:    {{use: pairs.exhaustive}}
  matches:  {{use: matches.brute_force}}
  poses:    {{use: poses.scaled_translation}}
  refined:  {{use: poses.refine}}
  metres:   {{use: poses.scale, gps: true, align: gps, gps_noise_m: 0.5}}
""")
    result = pano_mvs("run", workflow, "--out", "out")
    assert result.code == 0, result.text
    told = run_json(Path("out"))["poses"]
    assert told["registered"] == [f"00{number}.JPG" for number in range(4)]
    assert told["frame"].startswith("x east, y down, z north, by GPS")
    expected = np.array([60 * pose.center for pose in truth.values()])
    np.testing.assert_allclose(told["centers"], expected - expected[0] + told["centers"][0], atol=0.5)


WORKFLOW = """\
pano_mvs: 1
stages:
  images:   {use: source.folder, path: capture/images}
  poses:    {use: poses.from_model, path: poses.json}
"""
POINTS = """\
  features: {use: features.orb_tangent, max_keypoints: 400}
  pairs:    {use: pairs.exhaustive}
  matches:  {use: matches.brute_force}
  points:   {use: poses.triangulate}
"""


@pytest.fixture
def known(capture: Path) -> Path:
    path = capture.parent / "known.yaml"
    path.write_text(WORKFLOW)
    return path


def write(known: Path, capture: Path, names: list[str], *, one_place: bool = False) -> None:
    """Write a pose for each of the names, one after the other, from the capture's truth."""
    truth = json.loads((capture / "truth" / "poses.json").read_text())
    for view, name in zip(truth["views"], names, strict=False):
        view["image"] = name
        if one_place:
            view["t"] = [0, 0, 0]
    truth["views"] = truth["views"][: len(names)]
    (known.parent / "poses.json").write_text(json.dumps(truth))


@pytest.mark.slow
def test_one_pose_is_not_given_to_several_pictures(pano_mvs: Command, known: Path, capture: Path) -> None:
    images = capture / "images"
    for folder, names in (("a", ("000.png", "001.png")), ("b", ("002.png", "003.png"))):
        (images / folder).mkdir()
        for name in names:
            (images / name).rename(images / folder / f"{int(name[:3]) % 2:03}.png")
    write(known, capture, ["a/000.png", "a/001.png"])
    known.write_text(WORKFLOW + POINTS)
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 3, result.text
    assert run_json(Path("out"))["poses"]["registered"] == ["a/000.png", "a/001.png"]
    write(known, capture, ["000.png", "001.png"])
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 4
    assert "that matches several images" in result.flat


def test_cameras_in_one_place_are_refused(pano_mvs: Command, known: Path, capture: Path) -> None:
    write(known, capture, ["000.png", "001.png", "002.png"], one_place=True)
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 2
    assert "are in the same place" in result.flat
    assert Path("out/report.html").exists()


def test_names_of_another_capture_are_an_input_error(pano_mvs: Command, known: Path, capture: Path) -> None:
    write(known, capture, ["x.png", "y.png"])
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 2
    assert "none of its 2 images is one of this capture" in result.flat


def test_poses_of_other_pictures_of_the_same_names_are_refused(pano_mvs: Command, known: Path, capture: Path) -> None:
    """The sample's own poses were given to anybody's 000.png to 003.png once."""
    write(known, capture, ["000.png", "001.png", "002.png", "003.png"])
    assert pano_mvs("run", known, "--out", "out").code == 0
    for path in sorted((capture / "images").iterdir()):
        picture = read_picture(path)
        if path.name == "001.png":
            picture[0, 0] ^= 1
            cv2.imwrite(str(path), picture)
    touched = pano_mvs("run", known, "--out", "out")
    assert touched.code == 0
    assert "001.png is not the image whose pose poses.json records: the files differ" in touched.flat
    for path in sorted((capture / "images").iterdir()):
        cv2.imwrite(str(path), 255 - read_picture(path))
    others = pano_mvs("run", known, "--out", "out")
    assert others.code == 2
    assert "records other images under these names: not one of 4" in others.flat
    for path in sorted((capture / "images").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), read_picture(path))
        path.unlink()
    assert pano_mvs("run", known, "--out", "out").code == 0, "saved in another format, they must be others"


def test_the_presets_own_poses_are_for_its_own_pictures(pano_mvs: Command, capture: Path) -> None:
    result = pano_mvs("run", "known_poses", "--images", capture / "images", "--until", "poses", "--out", "out")
    assert result.code == 2
    assert "--set poses.path=FILE" in result.flat
