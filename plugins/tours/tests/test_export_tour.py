"""Level panoramas with their metadata and ranges, and tours of them whose links point at the other cameras."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import PIL.Image
import pytest
from pano_mvs_tours.exports import PanoramasParams, TourExportParams, panoramas, tour_of_panoramas

from pano_mvs.algorithms.faces.sampling import Facing, level_from_world, turned_panorama
from pano_mvs.api import Context, Pose, Poses, RangeMap, WorldAxes
from pano_mvs.geometry import Rigid3, ray_from_pixel, ray_grid, rotate_panorama, rotation_from_rotvec
from pano_mvs.io.images.captures import describe_picture
from pano_mvs.io.images.metadata import find_gpano, read_container
from pano_mvs.scene.files import LevelPanorama
from pano_mvs.stages.source import FolderParams, list_folder
from pano_mvs.testing.room import default_room, range_along, render
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.stored import read_picture

SIZE_HW = (96, 192)
CAPTURE = tiny_capture(Variant(SIZE_HW))


def poses_of(axes: WorldAxes = WorldAxes.NORTH) -> Poses:
    return replace(CAPTURE.whole(Poses), axes=axes)


def exported(folder: Path, poses: Poses, idx: int = 0, **settings: object) -> LevelPanorama:
    name = CAPTURE.names[idx]
    folder.mkdir(exist_ok=True)
    ranges = RangeMap(CAPTURE.ranges[idx], np.full(SIZE_HW, 200, np.uint8))
    params = PanoramasParams.model_validate(settings)
    ctx = Context(np.random.default_rng(0), folder)
    made = panoramas(CAPTURE.images[name], Pose(poses.cam_from_world(idx)), poses, ranges, params, ctx)
    made.check()
    return made


@pytest.mark.parametrize("facing", ["north", "path", "own"])
@pytest.mark.parametrize("form", ["jpg", "png"])
def test_pictures_and_ranges_are_what_a_level_camera_sees(tmp_path: Path, facing: str, form: str) -> None:
    poses = poses_of()
    made = exported(tmp_path, poses, 1, facing=facing, format=form)
    turn, center = np.array(made.level_from_world), poses.centers[1]
    assert turn[1] == pytest.approx([0, 1, 0], abs=1e-12)  # gravity is straight down
    picture = read_picture(made.files[f"panoramas/{{item}}.{form}"])[..., ::-1]
    expected = render(default_room(), Rigid3.from_center(turn, center), SIZE_HW)[0]
    assert np.corrcoef(picture.ravel(), expected.ravel())[0, 1] > 0.9  # one pixel off: 0.83
    ranges = read_picture(made.files["panoramas/range/{item}.tiff"], cv2.IMREAD_UNCHANGED)
    truth = range_along(default_room(), center, (ray_grid(SIZE_HW) @ turn).reshape(-1, 3))
    assert np.median(np.abs(ranges.ravel() / truth - 1)) < 0.02


def test_a_turn_is_the_slow_one() -> None:
    panorama = (128 + 100 * ray_grid(SIZE_HW)).astype(np.uint8)
    turn = rotation_from_rotvec(np.array([0.3, -1.2, 0.4]))
    fast = turned_panorama(panorama, turn).astype(int)
    assert np.abs(fast - rotate_panorama(panorama, turn)).max() <= 1


@pytest.mark.parametrize("form", ["jpg", "png"])
def test_the_metadata_is_read_by_others_and_by_us(tmp_path: Path, form: str) -> None:
    made = exported(tmp_path, poses_of(), format=form, facing="own")
    path = made.files[f"panoramas/{{item}}.{form}"]
    with PIL.Image.open(path) as picture:
        picture.load()
        packet = ElementTree.fromstring(picture.info["xmp" if form == "jpg" else "XML:com.adobe.xmp"])
    (fields,) = packet.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description")
    assert fields.get("{http://ns.google.com/photos/1.0/panorama/}FullPanoWidthPixels") == str(SIZE_HW[1])
    gpano, warnings = find_gpano(read_container(path.read_bytes()).xmp)
    assert gpano is not None
    assert not warnings
    assert gpano.full_size_hw == SIZE_HW
    assert gpano.up_in_cam == pytest.approx((0, -1, 0))
    ahead = poses_of().rotations[0, 2]
    assert gpano.heading_deg == pytest.approx(np.rad2deg(np.arctan2(ahead[0], ahead[2])) % 360, abs=1e-3)


def test_the_written_folder_is_a_capture(tmp_path: Path) -> None:
    """Its maps of ranges, which are TIFF files, failed as images."""
    folder = tmp_path / "written"
    for idx, form in enumerate(("jpg", "png")):
        for target, path in exported(tmp_path / form, poses_of(), idx, format=form).files.items():
            place = folder / target.format(item=f"hall {idx}")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(path.read_bytes())
    items = list(list_folder(FolderParams(path=folder / "panoramas")))
    assert [(item.name, item.problem) for item in items] == [("hall 0.jpg", ""), ("hall 1.png", "")]
    assert any("ranges" in note and "are skipped: hall 0.tiff, hall 1.tiff" in note for note in items[0].notes)
    info = describe_picture(items[0].files["image"])
    assert (info.size_hw, info.warnings, info.traits) == (SIZE_HW, (), ())


def test_what_is_not_known_is_not_stated(tmp_path: Path) -> None:
    made = exported(tmp_path, poses_of(WorldAxes.UNKNOWN))
    assert made.heading_deg is None
    gpano, _ = find_gpano(read_container(made.files["panoramas/{item}.jpg"].read_bytes()).xmp)
    assert gpano is not None
    assert gpano.heading_deg is None
    assert gpano.up_in_cam is None


def test_the_path_lies_ahead() -> None:
    poses = poses_of()
    turns = level_from_world(poses, "path")
    for idx in range(len(poses.names) - 1):
        step = turns[idx] @ (poses.centers[idx + 1] - poses.centers[idx])
        assert step[0] == pytest.approx(0, abs=1e-9)
        assert step[2] > 0


@pytest.mark.parametrize("facing", ["north", "path", "own"])
def test_directions_that_are_vertical_are_replaced(facing: Facing) -> None:
    """A camera that looks straight down, and the next one straight above it."""
    down = rotation_from_rotvec(np.array([np.pi / 2, 0, 0]))
    cameras = {"a": Rigid3.from_center(down, [0, 0, 0]), "b": Rigid3.from_center(down, [0, -1, 0])}
    turns = level_from_world(
        Poses.without_points(cameras, frame="", scale="", metric=False, axes=WorldAxes.NORTH), facing
    )
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)
    assert np.linalg.det(turns) == pytest.approx(1)


def tour(folder: Path, poses: Poses, *, facing: str = "own") -> dict[str, str]:
    made = {
        name: exported(folder / str(idx), poses, idx, facing=facing, ranges=False)
        for idx, name in enumerate(poses.names)
    }
    params = TourExportParams(players=("pannellum", "marzipano", "krpano"))
    files = tour_of_panoramas(made, poses, CAPTURE.images, params, Context(np.random.default_rng(0), folder))
    files.check()
    return {target: path.read_text() for target, path in files.files.items()}


def test_links_point_at_the_other_cameras(tmp_path: Path) -> None:
    """Unprojected as each player documents it, a link is the direction from one centre to the other."""
    poses = poses_of()
    files = tour(tmp_path, poses)
    turns, centers = level_from_world(poses, "own"), poses.centers
    pannellum = json.loads(files["panoramas/tour.json"])["scenes"]
    marzipano = json.loads(re.sub(r"^var APP_DATA = |;\n$", "", files["panoramas/marzipano.js"]))["scenes"]
    krpano = ElementTree.fromstring(files["panoramas/krpano.xml"]).findall("scene")
    height, width = SIZE_HW
    seen = 0
    for here, (scene, other_scene, krpano_scene) in enumerate(zip(pannellum.values(), marzipano, krpano, strict=True)):
        assert scene["panorama"] == other_scene["panorama"] == f"{CAPTURE.names[here].removesuffix('.png')}.jpg"
        for spot, link, hotspot in zip(
            scene["hotSpots"], other_scene["linkHotspots"], krpano_scene.findall("hotspot"), strict=True
        ):
            there = int(spot["sceneId"].removeprefix("scene_"))
            direction = centers[there] - centers[here]
            pixels = (
                (spot["yaw"] / 360 + 0.5, 0.5 - spot["pitch"] / 180),
                (link["yaw"] / (2 * np.pi) + 0.5, 0.5 + link["pitch"] / np.pi),
                (float(hotspot.get("ath", "nan")) / 360 + 0.5, 0.5 + float(hotspot.get("atv", "nan")) / 180),
            )
            for x, y in pixels:
                ray = turns[here].T @ ray_from_pixel([x * width, y * height], SIZE_HW)
                assert ray == pytest.approx(direction / np.linalg.norm(direction), abs=1e-4)
            level = turns[there] @ direction
            assert np.deg2rad(spot["targetYaw"]) == pytest.approx(np.arctan2(level[0], level[2]), abs=1e-4)
            assert link["target"] == spot["sceneId"] == hotspot.get("linkedscene")
            seen += 1
    assert seen >= 2 * (len(poses.names) - 1)
    assert pannellum["scene_0"]["northOffset"] == pytest.approx(
        np.rad2deg(np.arctan2(*poses.rotations[0, 2, [0, 2]])), abs=1e-6
    )


def test_every_panorama_can_be_reached(tmp_path: Path) -> None:
    scenes = json.loads(tour(tmp_path, poses_of())["panoramas/tour.json"])["scenes"]
    reached, waiting = {"scene_0"}, ["scene_0"]
    while waiting:
        new = {spot["sceneId"] for spot in scenes[waiting.pop()]["hotSpots"]} - reached
        reached |= new
        waiting += new
    assert reached == set(scenes)


def test_names_are_quoted(tmp_path: Path) -> None:
    poses = replace(poses_of(), names=('a b/#1 "x" <&>.png', *poses_of().names[1:]))
    made = {name: LevelPanorama({}, "panoramas/{item}.jpg") for name in poses.names}
    images = {name: CAPTURE.images[other] for name, other in zip(poses.names, CAPTURE.names, strict=True)}
    params = TourExportParams(players=("pannellum", "krpano"))
    files = tour_of_panoramas(made, poses, images, params, Context(np.random.default_rng(0), tmp_path)).files
    pannellum = json.loads(files["panoramas/tour.json"].read_text())
    assert pannellum["escapeHTML"] is True
    first = pannellum["scenes"]["scene_0"]
    assert first["panorama"] == "a%20b/%231%20%22x%22%20%3C%26%3E.jpg"
    scene = ElementTree.parse(files["panoramas/krpano.xml"]).find("scene")
    assert scene is not None
    assert scene.get("title") == 'a b/#1 "x" <&>'
    texts = {spot.get("text") for spot in ElementTree.parse(files["panoramas/krpano.xml"]).iter("hotspot")}
    assert 'a b/#1 "x" &lt;&amp;&gt;' in texts  # HTML
