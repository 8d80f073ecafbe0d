"""The splat bundle, read as its manifest says, by pycolmap, and as nerfstudio documents transforms.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from pano_mvs_splats.splat_bundle import SplatBundleParams, SplatFramesParams, splat_bundle, splat_frames

from pano_mvs.api import (
    FilePart,
    Panorama,
    PointCloud,
    Poses,
    RangeMap,
    Rigid3,
    ray_grid,
    write_png,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_confidence_png, read_normals
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.surfaces import TrackedPoints
from pano_mvs.testing.room import default_room, range_along
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.oracles.nerfstudio import world_points
from tests.stored import read_picture
from tests.synthetic.photograph import render_photograph
from tests.synthetic.published_frames import published, true_ranges

SIZE_HW = (128, 256)
STEP = 0.001
HALF_WIDTH = 2.0


def delivered(
    folder: Path,
    poses: Poses,
    images: dict[str, Panorama],
    ranges: dict[str, RangeMap],
    *,
    points: TrackedPoints | None = None,
    cloud: PointCloud | None = None,
    photographs: Photographs | None = None,
    listed: bool = True,
    **settings: Any,
) -> Path:
    """Write a bundle as a run does, through the store, and return its folder."""
    params, bundle = SplatFramesParams.model_validate(settings), SplatBundleParams(photographs=listed)
    out = published(
        folder,
        list(ranges),
        lambda name, ctx: splat_frames(images[name], ranges[name], params, ctx),
        whole=lambda frames, ctx: splat_bundle(frames, poses, cloud, points, photographs, bundle, ctx),
    )
    return out / "splat_bundle"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of the synthetic room with true ranges and points with tracks."""
    capture = tiny_capture(Variant(SIZE_HW))
    points = capture.whole(TrackedPoints)
    folder = tmp_path_factory.mktemp("room")
    return delivered(folder, capture.whole(Poses), capture.images, true_ranges(capture), points=points)


def manifest_of(folder: Path) -> dict[str, Any]:
    manifest: dict[str, Any] = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["schema"] == 1
    return manifest


def views_of(folder: Path, variant: str) -> list[dict[str, Any]]:
    return [view for view in manifest_of(folder)["views"] if view["variant"] == variant]


def depths_of(folder: Path, view: dict[str, Any]) -> FloatArray:
    """Return the depths of a view in scene units, NaN unknown, as the manifest describes them."""
    layer = manifest_of(folder)["layers"]["depth"]
    steps = read_picture(folder / view["depth"], cv2.IMREAD_UNCHANGED).astype(np.float64)
    return np.where(steps == layer["unknown"], np.nan, steps * layer["unit"])


def rays_of(view: dict[str, Any]) -> FloatArray:
    """Return the rays (h, w, 3) of a view's pixel centres by the formulas of the manifest, in its camera frame."""
    camera = view["camera"]
    x, y = np.meshgrid(np.arange(camera["width"]) + 0.5, np.arange(camera["height"]) + 0.5)
    if camera["model"] == "PINHOLE":
        ones = np.ones_like(x)
        return np.stack([(x - camera["cx"]) / camera["fx"], (y - camera["cy"]) / camera["fy"], ones], axis=-1)
    u, v = 2 * np.pi * (x / camera["width"] - 0.5), np.pi * (0.5 - y / camera["height"])
    return np.stack([np.cos(v) * np.sin(u), -np.sin(v), np.cos(v) * np.cos(u)], axis=-1)


def pose_of(view: dict[str, Any]) -> Rigid3:
    rows = np.array(view["cam_from_world"])
    return Rigid3(rows[:, :3], rows[:, 3])


def points_of(folder: Path, view: dict[str, Any]) -> FloatArray:
    """Return the points (h, w, 3) of a view in the world, NaN unknown."""
    return pose_of(view).inverse().apply(rays_of(view) * depths_of(folder, view)[..., None])


# A cubic cell around the camera: each face of the cube looks straight at one wall.


def cell_ranges(rotation: FloatArray | None = None) -> RangeMap:
    """Return the ranges from the centre of a cube whose walls are 2 units away, turned against the camera."""
    rays = ray_grid(SIZE_HW) if rotation is None else ray_grid(SIZE_HW) @ rotation.T
    ranges = (HALF_WIDTH / np.abs(rays).max(axis=-1)).astype(np.float32)
    return RangeMap(ranges, np.full(SIZE_HW, 200, np.uint8))


def cell(folder: Path, rotation: FloatArray | None = None) -> Path:
    """Write a bundle with one panorama in the cell."""
    capture = tiny_capture(Variant(SIZE_HW))
    name = capture.names[0]
    poses = Poses.without_points({name: Rigid3(np.eye(3), np.zeros(3))}, frame="the cell", scale="1 m", metric=True)
    return delivered(folder, poses, {name: capture.images[name]}, {name: cell_ranges(rotation)})


def test_the_z_depth_of_a_flat_wall_is_constant(tmp_path: Path) -> None:
    """The wall that a face looks at is 2 units away in all pixels within 45° of its axis; its range is up to 3.46."""
    folder = cell(tmp_path)
    faces = views_of(folder, "faces")
    assert len(faces) == 6
    for view in faces:
        assert view["depth_semantics"] == "z-depth"
        on_wall = np.abs(rays_of(view)[..., :2]).max(axis=-1) <= 0.97
        depths = depths_of(folder, view)[on_wall]
        assert on_wall.mean() > 0.7
        assert np.abs(depths - HALF_WIDTH).max() <= STEP  # half a step, and the interpolation of the ranges


def test_the_range_of_a_flat_wall_is_not(tmp_path: Path) -> None:
    folder = cell(tmp_path)
    (view,) = views_of(folder, "equirectangular")
    assert view["depth_semantics"] == "range along the ray"
    np.testing.assert_allclose(depths_of(folder, view), cell_ranges().range, atol=0.51 * STEP)
    assert depths_of(folder, view).max() > 1.7 * HALF_WIDTH  # in the corners


@pytest.mark.parametrize("pair", [("front", "right"), ("front", "up"), ("back", "left"), ("left", "down")])
def test_faces_agree_at_their_common_edge(tmp_path: Path, pair: tuple[str, str]) -> None:
    """Points of one face, projected to its neighbour, have the z-depth that the neighbour states there."""
    folder = cell(tmp_path, rotation_from_rotvec(np.array([0.3, 0.5, -0.2])))  # walls cross the edges at an angle
    views = {Path(view["image"]).name.split(".")[-2]: view for view in views_of(folder, "faces")}
    one, other = (views[name] for name in pair)
    points = points_of(folder, one).reshape(-1, 3)
    in_other = pose_of(other).apply(points)
    camera = other["camera"]
    x = in_other[:, 0] / in_other[:, 2] * camera["fx"] + camera["cx"] - 0.5
    y = in_other[:, 1] / in_other[:, 2] * camera["fy"] + camera["cy"] - 0.5
    inside = (in_other[:, 2] > 0) & (x >= 0) & (y >= 0) & (x <= camera["width"] - 1) & (y <= camera["height"] - 1)
    assert inside.sum() > 200
    stated = depths_of(folder, other).astype(np.float32)
    sampled = cv2.remap(stated, x[inside].astype(np.float32), y[inside].astype(np.float32), cv2.INTER_LINEAR)
    differences = np.abs(sampled.ravel() - in_other[inside, 2])
    assert np.median(differences) <= STEP
    assert np.quantile(differences, 0.95) < 0.01  # except at the edges of the cell, where planes meet


def test_ranges_continue_across_the_seam(tmp_path: Path) -> None:
    """The first and the last column are neighbours: their points are as near as those of any two columns."""
    folder = cell(tmp_path, rotation_from_rotvec(np.array([0.3, 0.5, -0.2])))
    (view,) = views_of(folder, "equirectangular")
    depths, points = depths_of(folder, view), points_of(folder, view)
    inside = np.abs(np.diff(depths, axis=1)).max(axis=1)
    assert (np.abs(depths[:, 0] - depths[:, -1]) <= inside + STEP).all()
    spacing = np.linalg.norm(np.diff(points, axis=1), axis=-1).max(axis=1)
    assert (np.linalg.norm(points[:, 0] - points[:, -1], axis=-1) <= spacing + 2 * STEP).all()
    walls = np.abs(points @ rotation_from_rotvec(np.array([0.3, 0.5, -0.2])).T).max(axis=-1)
    np.testing.assert_allclose(walls, HALF_WIDTH, atol=2 * STEP)


@pytest.mark.parametrize("variant", ["equirectangular", "faces"])
def test_points_by_the_manifest_are_on_the_walls(room: Path, variant: str) -> None:
    for view in views_of(room, variant):
        points = points_of(room, view).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=-1)]
        center = pose_of(view).center
        length = np.linalg.norm(points - center, axis=1)
        errors = np.abs(length - range_along(default_room(), center, (points - center) / length[:, None]))
        assert np.median(errors) < 2 * STEP


def test_normals_are_those_of_the_walls_in_the_frame_of_each_camera(tmp_path: Path) -> None:
    folder = cell(tmp_path)
    for view in manifest_of(folder)["views"]:
        normals = read_normals(folder / view["normal"])
        rays = rays_of(view)
        known = np.isfinite(depths_of(folder, view))
        assert (np.isfinite(normals).all(axis=-1) == known).all()
        assert (np.einsum("hwi,hwi->hw", normals, rays)[known] < 0).all()  # towards the camera
        if view["variant"] == "faces":
            on_wall = np.abs(rays[..., :2]).max(axis=-1) < 0.9
            assert on_wall.mean() > 0.6
            errors = np.linalg.norm(normals[on_wall] - [0, 0, -1], axis=-1)
            assert np.median(errors) < 0.01  # normals are fitted to ranges …
            assert errors.max() < 0.2  # … and less exact near the edges of the cell


def test_all_files_are_in_the_manifest_and_all_that_it_names_exist(room: Path) -> None:
    manifest = manifest_of(room)
    named = {"manifest.json"}
    for view in manifest["views"]:
        files = [view[key] for key in ("image", "mask", "depth", "normal", "confidence") if view[key]]
        assert files[0] == view["image"]
        assert len(files) == 4  # nothing is masked
        named |= set(files)
    (group,) = manifest["groups"]
    assert group["variants"].keys() == {"equirectangular", "faces"}
    for places in group["variants"].values():
        named |= {places["transforms"], places["seeds"]}
        named |= {path.relative_to(room).as_posix() for path in (room / places["colmap"]).iterdir()}
    assert named == {path.relative_to(room).as_posix() for path in room.rglob("*") if path.is_file()}


@pytest.mark.parametrize("variant", ["equirectangular", "faces"])
def test_pycolmap_reads_the_cameras_of_the_manifest(room: Path, variant: str) -> None:
    """The layout is that of gsplat's loader and of others: images/ beside sparse/0, every image with points."""
    model = pycolmap.Reconstruction(str(room / variant / "sparse" / "0"))
    images = {image.name: image for image in model.images.values()}
    views = {view["image"]: view for view in views_of(room, variant)}
    assert {f"{variant}/images/{name}" for name in images} == views.keys()
    assert sorted(images) == sorted(
        path.relative_to(room / variant / "images").as_posix() for path in (room / variant / "images").rglob("*.*g")
    )
    for name, image in images.items():
        view = views[f"{variant}/images/{name}"]
        np.testing.assert_allclose(image.cam_from_world().matrix(), view["cam_from_world"], atol=1e-12)
        camera = model.cameras[image.camera_id]
        assert camera.model.name == view["camera"]["model"]
        assert (camera.width, camera.height) == (view["camera"]["width"], view["camera"]["height"])
        assert read_picture(room / view["image"]).shape[:2] == (camera.height, camera.width)
        assert image.num_points3D > 0 or variant == "faces"
        assert {point.point3D_id for point in image.get_observation_points2D()} <= set(model.points3D)
        if variant == "faces":
            calibration = camera.calibration_matrix()  # as gsplat's loader reads it
            assert calibration[0, 0] == view["camera"]["fx"]
            assert calibration[1, 2] == view["camera"]["cy"]
            assert list(camera.params) == [view["camera"][key] for key in ("fx", "fy", "cx", "cy")]


def test_points_of_the_model_have_the_depths_of_the_faces(room: Path) -> None:
    model = pycolmap.Reconstruction(str(room / "faces" / "sparse" / "0"))
    views = {Path(view["image"]).name: view for view in views_of(room, "faces")}
    errors = []
    for image in model.images.values():
        depths = depths_of(room, views[image.name])
        for observation in image.points2D:
            x, y = np.floor(observation.xy).astype(int)
            in_cam = image.cam_from_world() * model.points3D[observation.point3D_id].xyz
            errors.append(abs(depths[y, x] - in_cam[2]) / in_cam[2])
    assert len(errors) > 300
    assert np.median(errors) < 0.01  # pixels of 1.4°


@pytest.mark.parametrize("variant", ["equirectangular", "faces"])
def test_nerfstudio_reads_the_same_points(room: Path, variant: str) -> None:
    """The documented reading of transforms.json, in OpenGL's axes, gives the points of the manifest's."""
    document = json.loads((room / variant / "transforms.json").read_text())
    for frame, view in zip(document["frames"], views_of(room, variant), strict=True):
        assert f"{variant}/{frame['file_path']}" == view["image"]
        points, known = world_points(room / variant, document, frame)
        np.testing.assert_allclose(points, points_of(room, view)[known], atol=1e-9)
    seeds = read_ply(room / variant / document["ply_file_path"])
    capture = tiny_capture(Variant(SIZE_HW))
    assert len(seeds) == len(capture.whole(Poses).points_in_world)


def test_the_code_of_the_documentation_gives_points_on_the_walls(room: Path) -> None:
    code = (Path(__file__).parents[2] / "examples" / "splat_points.py").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    exec(code.replace("lobby/splat_bundle", room.as_posix()), names)
    expected = points_of(room, names["view"])
    np.testing.assert_allclose(names["in_world"], expected[np.isfinite(expected).all(axis=-1)], atol=1e-9)


PHOTO_HW = (60, 80)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    """Two photographs of the room by cameras with distortion, one upright."""
    folder = tmp_path_factory.mktemp("phone")
    poses = [
        Rigid3.from_center(rotation_from_rotvec(np.array(turn)), np.array([0.2, 0.1, 0.1]))
        for turn in ([0.1, 0.6, -0.1], [0.0, -2.0, 0.1])
    ]
    sizes, focals, radials = [PHOTO_HW, PHOTO_HW[::-1]], np.array([70.0, 90.0]), np.array([-0.15, 0.1])
    for idx, pose in enumerate(poses):
        picture = render_photograph(
            default_room(), pose, sizes[idx], focal_px=focals[idx], radial=radials[idx], supersample=1
        )
        write_png(folder / f"{idx}.png", picture)
    return Photographs(
        names=("phone/0.png", "phone/1.png"),
        sizes_hw=np.array(sizes, np.int32),
        focals_px=focals,
        radials=radials,
        rotations=np.array([pose.rotation for pose in poses]),
        translations=np.array([pose.translation for pose in poses]),
        inliers=np.array([50, 50], np.int32),
        errors_px=np.array([0.5, 0.5], np.float32),
        pictures=tuple(FilePart(folder / f"{idx}.png") for idx in range(2)),
    )


@pytest.fixture(scope="module")
def with_photographs(photographs: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle with photographs; some panoramas are masked."""
    capture, folder = tiny_capture(Variant((64, 128), masked=True)), tmp_path_factory.mktemp("mixed")
    points = capture.whole(TrackedPoints)
    return delivered(
        folder,
        capture.whole(Poses),
        capture.images,
        true_ranges(capture),
        points=points,
        photographs=photographs,
        size_px=48,
    )


def files_of(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_photographs_are_pinhole_cameras_of_the_model_of_faces(
    with_photographs: Path, photographs: Photographs
) -> None:
    """As readers of pinhole models see them: the pictures show the room where the cameras are."""
    model = pycolmap.Reconstruction(str(with_photographs / "faces" / "sparse" / "0"))
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    images = {image.name: image for image in model.images.values()}
    for idx, name in enumerate(photographs.names):
        image = images[f"{name}.jpg"]
        pose = photographs.cam_from_world(idx)
        np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], pose.rotation, atol=1e-12)
        camera = model.cameras[image.camera_id]
        picture = read_picture(with_photographs / "faces" / "images" / image.name)[..., ::-1]
        assert picture.shape[:2] == (camera.height, camera.width) == tuple(photographs.sizes_hw[idx])
        expected = render_photograph(default_room(), pose, picture.shape[:2], focal_px=camera.params[0], supersample=1)
        away = np.abs(picture.astype(float) - expected).mean()
        assert away < 0.6 * np.abs(picture[:, 1:].astype(float) - expected[:, :-1]).mean()
    faces = [image for image in model.images.values() if "phone" not in image.name]
    assert len(faces) == len(views_of(with_photographs, "faces"))
    assert any(image.num_points3D for image in faces)
    panoramas = pycolmap.Reconstruction(str(with_photographs / "equirectangular" / "sparse" / "0"))
    assert {camera.model.name for camera in panoramas.cameras.values()} == {"EQUIRECTANGULAR"}


def test_the_manifest_and_nerfstudio_list_the_same_photographs(with_photographs: Path) -> None:
    manifest = manifest_of(with_photographs)
    variants = manifest["groups"][0]["variants"]
    assert "photographs" not in variants["equirectangular"]
    document = json.loads((with_photographs / variants["faces"]["photographs"]).read_text())
    assert document["camera_model"] == "PINHOLE"
    assert document["ply_file_path"] == "seed.ply"
    frames = {frame["file_path"]: frame for frame in document["frames"]}
    assert len(frames) == len(views_of(with_photographs, "faces")) + 2
    assert len(manifest["photographs"]) == 2
    for listed in manifest["photographs"]:
        frame, camera = frames[listed["image"].removeprefix("faces/")], listed["camera"]
        assert (frame["w"], frame["h"], frame["fl_x"]) == (camera["width"], camera["height"], camera["fx"])
        assert "k1" not in frame
        world_from_cam = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        pose = pose_of(listed)
        np.testing.assert_allclose(world_from_cam[:3, :3], pose.rotation.T, atol=1e-12)
        np.testing.assert_allclose(world_from_cam[:3, 3], pose.center, atol=1e-12)
        assert f"faces/{frame['mask_path']}" == listed["mask"]
        assert read_picture(with_photographs / listed["mask"]).shape[:2] == (camera["height"], camera["width"])


def test_photographs_change_nothing_else_and_can_be_left_out(photographs: Photographs, tmp_path: Path) -> None:
    capture = tiny_capture(Variant((64, 128)))
    ranges = dict(list(true_ranges(capture).items())[:1])
    bundles = []
    for number, (given, listed) in enumerate([(None, True), (photographs, False), (photographs, True)]):
        (tmp_path / str(number)).mkdir()
        made = (capture.whole(Poses), capture.images, ranges)
        bundles.append(files_of(delivered(tmp_path / str(number), *made, photographs=given, listed=listed, size_px=24)))
    plain, left_out, full = bundles
    assert left_out == plain
    changed = {name for name in full if full[name] != plain.get(name)}
    assert changed == {
        "manifest.json",
        "faces/images/phone/0.png.jpg",
        "faces/images/phone/1.png.jpg",
        "faces/transforms_photographs.json",
        *(f"faces/sparse/0/{name}.bin" for name in ("cameras", "frames", "images", "rigs")),
    }
    document = json.loads(full["manifest.json"])
    del document["photographs"]
    del document["groups"][0]["variants"]["faces"]["photographs"]
    assert document == json.loads(plain["manifest.json"])


def test_photographs_need_faces(photographs: Photographs, tmp_path: Path) -> None:
    capture = tiny_capture(Variant((64, 128)))
    folder = delivered(
        tmp_path,
        capture.whole(Poses),
        capture.images,
        true_ranges(capture),
        photographs=photographs,
        variants=["equirectangular"],
    )
    assert "photographs" not in manifest_of(folder)
    assert not (folder / "faces").exists()


def test_masked_pixels_have_no_layer(tmp_path: Path) -> None:
    capture = tiny_capture(Variant((64, 128), masked=True))
    images = dict(capture.images)
    images["001.png"] = replace(images["001.png"], mask_file=None)
    folder = delivered(tmp_path, capture.whole(Poses), images, true_ranges(capture), size_px=48)
    for view in manifest_of(folder)["views"]:
        used = read_picture(folder / view["mask"], cv2.IMREAD_UNCHANGED) > 0
        assert used.all() == (view["panorama"] == "001.png" or used.all())
        assert not np.isfinite(depths_of(folder, view)[~used]).any()
        assert not np.isfinite(read_normals(folder / view["normal"])[~used]).any()
        assert not read_confidence_png(folder / view["confidence"])[~used].any()
    views = {view["panorama"] for view in manifest_of(folder)["views"] if "none_" in view["mask"]}
    assert "001.png" in views


def test_confidence_is_that_of_the_ranges_and_weak_depths_can_be_left_out(tmp_path: Path) -> None:
    capture = tiny_capture(Variant(SIZE_HW))
    name = capture.names[0]
    confidence = np.full(SIZE_HW, 200, np.uint8)
    confidence[: SIZE_HW[0] // 2] = 40
    ranges = {name: RangeMap(capture.ranges[0], confidence)}
    poses = capture.whole(Poses)
    folder = delivered(tmp_path, poses, capture.images, ranges, variants=["equirectangular"])
    (view,) = manifest_of(folder)["views"]
    written = read_confidence_png(folder / view["confidence"])
    assert set(np.unique(written[: SIZE_HW[0] // 2])) == {0}
    assert set(np.unique(written[SIZE_HW[0] // 2 :])) == {200}
    assert not np.isfinite(depths_of(folder, view)[: SIZE_HW[0] // 2]).any()
    assert not (folder / "faces").exists()


def test_layers_that_are_not_wanted_are_null(tmp_path: Path) -> None:
    capture = tiny_capture(Variant((64, 128)))
    name = capture.names[0]
    ranges = {name: true_ranges(capture)[name]}
    folder = delivered(tmp_path, capture.whole(Poses), capture.images, ranges, normals=False, confidence=False)
    for view in manifest_of(folder)["views"]:
        assert view["normal"] is None
        assert view["confidence"] is None
        assert view["depth"]
    assert not (folder / "faces" / "normals").exists()
