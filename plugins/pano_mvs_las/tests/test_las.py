"""LAS, LAZ and E57 hold the cloud, as laspy and pye57 read it, where GPS says that it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import laspy
import numpy as np
import pye57
import pytest
from pano_mvs.api import (
    Context,
    InputError,
    Panorama,
    Params,
    PointCloud,
    Poses,
    Rigid3,
    UsageError,
    WorldAxes,
    ray_from_pixel,
)
from pano_mvs.io import point_selection
from pano_mvs.testing.conformance import ContractTest, stage_contract_tests
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from pye57 import libe57
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from pano_mvs_las import e57, las, poses_e57, source_e57
from pano_mvs_las.e57_panoramas import list_panoramas, read_picture
from pano_mvs_las.sources import PosesParams, SourceParams, list_items
from pano_mvs_las.stages import CloudParams, E57Params, LasParams

HERE = (47.5, 8.25, 410.0)


def a_cloud(count: int = 1000, *, reach: float = 20.0) -> PointCloud:
    rng = np.random.default_rng(count)
    normals = rng.normal(size=(count, 3))
    return PointCloud(
        rng.uniform(-reach, reach, (count, 3)).astype(np.float32),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        rng.integers(1, 9, count).astype(np.uint8),
        rng.integers(1, 256, count).astype(np.uint8),
    )


def the_poses(origin_lla: tuple[float, float, float] | None = None) -> Poses:
    return placed({"a.jpg": Rigid3.identity()}, origin_lla)


def placed(cameras: dict[str, Rigid3], origin_lla: tuple[float, float, float] | None) -> Poses:
    axes = WorldAxes.UNKNOWN if origin_lla is None else WorldAxes.NORTH
    return Poses.without_points(cameras, frame="", scale="", metric=True, axes=axes, origin_lla=origin_lla)


def written(stage: Any, folder: Path, cloud: PointCloud, poses: Poses, params: Params) -> Path:
    folder.mkdir(exist_ok=True)
    ctx = Context(np.random.default_rng(0), folder)
    inputs = (cloud, poses) if stage is las else (cloud, poses, None)
    (path,) = stage(*inputs, params, ctx).files.values()
    return Path(path)


def e57_points(path: Path) -> dict[str, np.ndarray]:
    with pye57.E57(str(path)) as file:
        return dict(file.read_scan(0, colors=True, ignore_missing_fields=True))


@pytest.mark.parametrize("contract_test", [*stage_contract_tests(las), *stage_contract_tests(e57)], ids=str)
def test_keeps_the_contract(contract_test: ContractTest) -> None:
    contract_test.check()


def test_a_world_that_has_z_up_already_is_not_turned(tmp_path: Path) -> None:
    """Such as a COLMAP model that another program aligned."""
    cam_from_world = Rigid3(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    poses = Poses.without_points({"a.jpg": cam_from_world}, frame="of a file", scale="", metric=False)
    read = laspy.read(written(las, tmp_path, a_cloud(), poses, LasParams()))
    np.testing.assert_allclose(np.asarray(read.xyz), a_cloud().points_in_world, atol=0.0001)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_las_file_holds_the_cloud_with_z_up(tmp_path: Path, suffix: Literal["las", "laz"]) -> None:
    cloud = a_cloud()
    path = written(las, tmp_path, cloud, the_poses(), LasParams(format=suffix))
    read = laspy.read(path)
    assert read.header.version == laspy.header.Version(1, 4)
    x, y, z = cloud.points_in_world.T
    np.testing.assert_allclose(read.xyz, np.stack([x, z, -y], axis=-1), atol=0.5001e-4)
    for name, values in zip(("red", "green", "blue"), cloud.colors_rgb.T, strict=True):
        np.testing.assert_array_equal(np.asarray(read[name]) >> 8, values)
        assert set(np.asarray(read[name])[values == 255]) <= {65535}
    nx, ny, nz = cloud.normals_in_world.T
    np.testing.assert_array_equal(read["NormalX"], nx)
    np.testing.assert_array_equal(read["NormalY"], nz)
    np.testing.assert_array_equal(read["NormalZ"], -ny)
    np.testing.assert_array_equal(read["views"], cloud.view_counts)
    np.testing.assert_array_equal(read["confidence"], cloud.confidence)
    assert read.header.parse_crs() is None


def test_compressed_is_smaller_and_the_same(tmp_path: Path) -> None:
    cloud = a_cloud(5000)
    plain = written(las, tmp_path / "a", cloud, the_poses(), LasParams(format="las"))
    packed = written(las, tmp_path / "b", cloud, the_poses(), LasParams(format="laz"))
    assert packed.stat().st_size < 0.9 * plain.stat().st_size
    np.testing.assert_array_equal(laspy.read(packed).xyz, laspy.read(plain).xyz)


def test_gps_puts_the_cloud_on_the_map_of_its_zone(tmp_path: Path) -> None:
    """Ten metres east, twenty north and three up of the origin are that on the map, to its scale and convergence."""
    world = np.array([[0, 0, 0], [10, -3, 20]], np.float32)
    up = np.array([[0, -1, 0]] * 2, np.float32)
    cloud = PointCloud(world, up, np.zeros((2, 3), np.uint8), np.ones(2, np.uint8))
    read = laspy.read(written(las, tmp_path, cloud, the_poses(HERE), LasParams()))
    crs = read.header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == 32632
    to_map = Transformer.from_crs(4979, 32632, always_xy=True)
    np.testing.assert_allclose(read.xyz[0], to_map.transform(8.25, 47.5, 410.0), atol=1e-3)
    np.testing.assert_allclose(read.xyz[1] - read.xyz[0], (10, 20, 3), atol=0.25)
    back = Transformer.from_crs(32632, 4978, always_xy=True).transform(*read.xyz.T)
    assert np.linalg.norm(np.diff(back, axis=1)) == pytest.approx(np.linalg.norm(world[1]), abs=1e-3)
    np.testing.assert_array_equal(read["NormalZ"], [1, 1])


def test_another_map_or_none(tmp_path: Path) -> None:
    cloud = a_cloud(50)
    swiss = laspy.read(written(las, tmp_path / "a", cloud, the_poses(HERE), LasParams(epsg=2056)))
    assert swiss.header.parse_crs() == CRS.from_epsg(2056)
    assert 2.4e6 < swiss.xyz[:, 0].mean() < 2.9e6
    none = laspy.read(written(las, tmp_path / "b", cloud, the_poses(HERE), LasParams(epsg=0)))
    assert none.header.parse_crs() is None
    assert np.abs(none.xyz).max() < 21
    for epsg, what in ((4326, "not projected"), (999999, "not a coordinate system that PROJ knows")):
        with pytest.raises(UsageError, match=what):
            written(las, tmp_path / "c", cloud, the_poses(HERE), LasParams(epsg=epsg))
    with pytest.raises(UsageError, match="needs cameras that GPS has placed"):
        written(las, tmp_path / "d", cloud, the_poses(), LasParams(epsg=2056))


def test_steps_that_are_too_small_are_refused_with_those_that_are_not(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"does not fit into steps of 1e-09: set `step` to 2e-08 or more"):
        written(las, tmp_path, a_cloud(50), the_poses(), LasParams(step=1e-9))


def test_an_e57_file_holds_the_cloud(tmp_path: Path) -> None:
    cloud = a_cloud()
    points = e57_points(written(e57, tmp_path, cloud, the_poses(), E57Params()))
    x, y, z = cloud.points_in_world.T
    for name, values in (("cartesianX", x), ("cartesianY", z), ("cartesianZ", -y)):
        np.testing.assert_array_equal(points[name], values)
    for name, values in zip(("colorRed", "colorGreen", "colorBlue"), cloud.colors_rgb.T, strict=True):
        np.testing.assert_array_equal(points[name], values)


def test_an_e57_file_has_normals_and_a_map(tmp_path: Path) -> None:
    cloud = a_cloud()
    path = written(e57, tmp_path, cloud, the_poses(HERE), E57Params())
    with pye57.E57(str(path)) as file:
        header = file.get_header(0)
        assert header.point_count == len(cloud)
        assert {"nor:normalX", "nor:normalY", "nor:normalZ"} <= set(header.point_fields)
        assert CRS.from_wkt(file.root["coordinateMetadata"].value()).to_epsg() == 32632
    points = e57_points(path)
    on_map = laspy.read(written(las, tmp_path / "las", cloud, the_poses(HERE), LasParams())).xyz
    np.testing.assert_allclose(
        np.stack([points[f"cartesian{axis}"] for axis in "XYZ"], axis=-1), on_map, atol=0.5001e-4
    )


@pytest.mark.parametrize(("stage", "params"), [(las, LasParams), (e57, E57Params)])
def test_points_that_are_not_wanted_are_left_out_in_any_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: Any, params: type[CloudParams]
) -> None:
    cloud = a_cloud()
    wanted = params.model_validate({"min_views": 4, "min_confidence": 60, "voxel": 3.0})
    whole = written(stage, tmp_path / "a", cloud, the_poses(), wanted)
    count = len(laspy.read(whole)) if stage is las else len(e57_points(whole)["cartesianX"])
    assert cloud.confidence is not None
    good = int(((cloud.view_counts >= 4) & (cloud.confidence >= 60)).sum())
    assert 0.5 * good < count <= good
    monkeypatch.setattr(point_selection, "CHUNK_POINTS", 64)
    again = written(stage, tmp_path / "b", cloud, the_poses(), wanted)
    if stage is las:
        np.testing.assert_array_equal(laspy.read(again).xyz, laspy.read(whole).xyz)
    else:
        np.testing.assert_array_equal(e57_points(again)["cartesianX"], e57_points(whole)["cartesianX"])
    with pytest.raises(InputError, match="no points that could be written"):
        written(stage, tmp_path / "c", cloud, the_poses(), params.model_validate({"min_views": 99}))


CAPTURE = tiny_capture(Variant((128, 256), masked=True))


def in_pictures(idx: int, count: int = 300) -> tuple[np.ndarray, PointCloud]:
    """Return pixels (N, 2) that one panorama sees, and the points there, in the colours of the pixels."""
    name, pose = CAPTURE.names[idx], CAPTURE.poses[idx]
    rows, columns = np.nonzero(CAPTURE.images[name].load_mask())
    chosen = np.random.default_rng(idx).choice(len(rows), count, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    pixels = np.stack([columns, rows], axis=-1) + 0.5
    rays = ray_from_pixel(pixels, CAPTURE.pictures[idx].shape[:2])
    points = pose.inverse().apply(rays * CAPTURE.ranges[idx][rows, columns, None])
    colors = CAPTURE.pictures[idx][rows, columns]
    cloud = PointCloud(points.astype(np.float32), -rays.astype(np.float32), colors, np.ones(count, np.uint8))
    return pixels, cloud


def blob(node: Any) -> np.ndarray:
    data = bytearray(node.byteCount())
    node.read(data, 0, len(data))
    return np.frombuffer(bytes(data), np.uint8)


@pytest.mark.parametrize("origin_lla", [None, HERE], ids=["upright", "on a map"])
@pytest.mark.parametrize("idx", [0, 2])
def test_points_of_an_e57_file_lie_on_their_pixels_as_the_standard_defines_them(
    tmp_path: Path, idx: int, origin_lla: tuple[float, float, float] | None
) -> None:
    """ASTM E2807-11, 8.4.14.5: x = imageWidth / 2 − θ / pixelWidth, y = imageHeight / 2 − φ / pixelHeight.

    θ is the azimuth from the x axis towards y and φ the elevation (5.5), in the frame of the image, which `pose` moves
    to that of the file: x_file = R x_image + t.
    """
    pixels, cloud = in_pictures(idx)
    poses = placed(dict(zip(CAPTURE.names, CAPTURE.poses, strict=True)), origin_lla)
    ctx = Context(np.random.default_rng(0), tmp_path)
    (path,) = e57(cloud, poses, CAPTURE.images, E57Params(), ctx).files.values()
    points = e57_points(path)
    with pye57.E57(str(path)) as file:
        assert len(file.root["images2D"]) == len(CAPTURE.names)
        image = file.root["images2D"][idx]
        assert image["name"].value() == CAPTURE.names[idx]
        sphere, pose = image["sphericalRepresentation"], image["pose"]
        width, height = sphere["imageWidth"].value(), sphere["imageHeight"].value()
        quaternion = [pose["rotation"][axis].value() for axis in "xyzw"]
        assert quaternion[3] >= 0
        place = np.array([pose["translation"][axis].value() for axis in "xyz"])
        in_file = np.stack([points[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
        x, y, z = ((in_file - place) @ Rotation.from_quat(quaternion).as_matrix()).T
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
        x_image = width / 2 - azimuth / sphere["pixelWidth"].value()
        y_image = height / 2 - elevation / sphere["pixelHeight"].value()
        picture = np.asarray(cv2.imdecode(blob(sphere["jpegImage"]), cv2.IMREAD_COLOR))[..., ::-1]
        mask = np.asarray(cv2.imdecode(blob(sphere["imageMask"]), cv2.IMREAD_GRAYSCALE))
    assert picture.shape == (height, width, 3) == CAPTURE.pictures[idx].shape
    np.testing.assert_array_equal(mask > 0, CAPTURE.images[CAPTURE.names[idx]].load_mask())
    size_hw = (height, width)
    found = ray_from_pixel(np.stack([x_image, y_image], axis=-1), size_hw)
    # The scale of a map is .9996, but not that of its heights.
    np.testing.assert_allclose(found, ray_from_pixel(pixels, size_hw), atol=5e-4 if origin_lla else 1e-6)
    colors = np.stack([points[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=-1)
    seen = picture[y_image.astype(int), x_image.astype(int)]
    assert np.abs(seen.astype(int) - colors).mean() < 6  # JPEG; 40 between random pixels


def test_panoramas_of_an_e57_file_are_optional_and_the_same_each_time(tmp_path: Path) -> None:
    poses = Poses.without_points(dict(zip(CAPTURE.names, CAPTURE.poses, strict=True)), frame="", scale="", metric=True)

    def bytes_of(name: str, images: dict[str, Panorama] | None, params: E57Params) -> bytes:
        (tmp_path / name).mkdir()
        ctx = Context(np.random.default_rng(0), tmp_path / name)
        (path,) = e57(in_pictures(0)[1], poses, images, params, ctx).files.values()
        return Path(path).read_bytes()

    whole = bytes_of("a", CAPTURE.images, E57Params())
    assert whole == bytes_of("b", CAPTURE.images, E57Params())
    bare = bytes_of("c", CAPTURE.images, E57Params(panoramas=False))
    assert bare == bytes_of("d", None, E57Params())
    assert len(whole) > len(bare) + 4 * 3000


CAMERAS = dict(zip(CAPTURE.names, CAPTURE.poses, strict=True))


def a_file(folder: Path, origin_lla: tuple[float, float, float] | None) -> Path:
    """Write the masked panoramas of a capture as E57."""
    folder.mkdir()
    ctx = Context(np.random.default_rng(0), folder)
    (path,) = e57(in_pictures(0)[1], placed(CAMERAS, origin_lla), CAPTURE.images, E57Params(), ctx).files.values()
    return Path(path)


def read_back(path: Path, folder: Path) -> dict[str, Panorama]:
    params = SourceParams(path=path)
    images = {}
    for item in list_items(params):
        (folder / item.name).mkdir(parents=True)
        images[item.name] = source_e57(item, params, Context(np.random.default_rng(0), folder / item.name))
    return images


@pytest.mark.parametrize("origin_lla", [None, HERE], ids=["upright", "on a map"])
def test_panoramas_and_poses_come_back_out_of_an_e57_file(
    tmp_path: Path, origin_lla: tuple[float, float, float] | None
) -> None:
    path = a_file(tmp_path / "out", origin_lla)
    images = read_back(path, tmp_path / "in")
    assert list(images) == [f"{Path(name).stem}.jpg" for name in CAPTURE.names]
    for name, own in zip(images, CAPTURE.names, strict=True):
        np.testing.assert_array_equal(images[name].load_mask(), CAPTURE.images[own].load_mask())
        shown = CAPTURE.images[own].load_mask()
        apart = np.abs(images[name].load().astype(int) - CAPTURE.images[own].load())[shown]
        assert apart.mean() < 6
    ctx = Context(np.random.default_rng(0), tmp_path)
    poses = poses_e57(images, PosesParams(path=path), ctx)
    assert poses.metric
    true = np.array([pose.center for pose in CAPTURE.poses])
    found = poses.centers
    np.testing.assert_allclose(
        np.linalg.norm(found[1:] - found[0], axis=1), np.linalg.norm(true[1:] - true[0], axis=1), rtol=1e-3
    )
    for idx, other in ((0, 1), (1, 2)):
        turn = poses.rotations[other] @ poses.rotations[idx].T
        expected = CAPTURE.poses[other].rotation @ CAPTURE.poses[idx].rotation.T
        np.testing.assert_allclose(turn, expected, atol=1e-3)
        ahead = poses.rotations[idx] @ (found[other] - found[idx])
        np.testing.assert_allclose(
            ahead, CAPTURE.poses[idx].rotation @ (true[other] - true[idx]), atol=1e-3 if origin_lla else 1e-6
        )
    assert np.abs(poses.centers).max() < 10_000
    assert ("minus (" in poses.frame) == (origin_lla is not None)


def sphere(picture: np.ndarray, **changes: Any) -> dict[str, Any]:
    height, width = picture.shape[:2]
    stated = {
        "imageWidth": width,
        "imageHeight": height,
        "pixelWidth": 2 * np.pi / width,
        "pixelHeight": np.pi / height,
        "pngImage": cv2.imencode(".png", picture[..., ::-1])[1].tobytes(),
    }
    return {name: value for name, value in (stated | changes).items() if value is not None}


def pose_at(x: float, y: float = 0.0, z: float = 0.0) -> dict[str, Any]:
    return {"rotation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}, "translation": {"x": x, "y": y, "z": z}}


def file_of(path: Path, images: list[dict[str, Any]]) -> Path:
    """Write images, given by the values of their nodes, as other programs might."""
    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    blobs: list[tuple[Any, bytes]] = []
    nodes = libe57.VectorNode(file, True)
    file.root().set("images2D", nodes)
    for image in images:
        node = libe57.StructureNode(file)
        nodes.append(node)
        fill(file, node, image, blobs)
    for node, data in blobs:
        node.write(data, 0, len(data))
    file.close()
    return path


def fill(file: Any, node: Any, values: dict[str, Any], blobs: list[tuple[Any, bytes]]) -> None:
    simple = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    for name, value in values.items():
        if isinstance(value, dict):
            node.set(name, child := libe57.StructureNode(file))
            fill(file, child, value, blobs)
        elif isinstance(value, bytes):
            node.set(name, child := libe57.BlobNode(file, len(value)))
            blobs.append((child, value))
        else:
            node.set(name, simple[type(value)](file, value))


PICTURE = np.random.default_rng(0).integers(0, 256, (64, 128, 3)).astype(np.uint8)


def test_what_an_e57_file_does_not_say_is_unknown(tmp_path: Path) -> None:
    """No names, the same names, names that are no file names, no pose, and images of other kinds."""
    path = file_of(
        tmp_path / "scan.e57",
        [
            {"sphericalRepresentation": sphere(PICTURE), "pose": pose_at(0.0)},
            {"name": "a/b: 1", "sphericalRepresentation": sphere(PICTURE), "pose": pose_at(1.0)},
            {"name": "c.png", "sphericalRepresentation": sphere(PICTURE)},
            {"name": "c.png", "sphericalRepresentation": sphere(PICTURE), "pose": pose_at(2.0)},
            {"name": "C.jpg", "sphericalRepresentation": sphere(PICTURE)},
            {"name": "con", "sphericalRepresentation": sphere(PICTURE)},
            {"name": "広" * 240, "sphericalRepresentation": sphere(PICTURE)},
            {"name": "cam 0", "pinholeRepresentation": {"imageWidth": 4}},
        ],
    )
    items = list(list_items(SourceParams(path=path)))
    named = ["image_0000.png", "a_b_ 1.png", "c.png", "c_0003.png", "C_0004.png", "image_con.png", f"{'広' * 26}.png"]
    assert [item.name for item in items] == named
    assert not any(item.problem for item in items)
    note = "scan.e57: 1 image of a pinhole camera is not used: only spherical images are panoramas"
    assert all(item.notes == (note,) for item in items)
    images = read_back(path, tmp_path / "in")
    np.testing.assert_array_equal(images["c.png"].load(), PICTURE)
    assert images["c.png"].crop_ltwh is None
    poses = poses_e57(images, PosesParams(path=path), Context(np.random.default_rng(0), tmp_path))
    assert poses.names == ("image_0000.png", "a_b_ 1.png", "c_0003.png")
    assert poses.rejected == dict.fromkeys(["c.png", *named[4:]], "scan.e57 has no pose of it")
    np.testing.assert_allclose(poses.centers, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-12)
    # The middle of the picture, our z axis, is the x axis of the image, and up is up.
    np.testing.assert_allclose(poses.rotations[0].T @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses.rotations[0].T @ [0, -1, 0], [0, 0, 1], atol=1e-12)


def test_a_part_of_the_sphere_is_around_the_middle(tmp_path: Path) -> None:
    part = sphere(PICTURE[16:48], pixelHeight=2 * np.pi / 128)
    images = [{"sphericalRepresentation": part, "pose": pose_at(float(idx))} for idx in range(2)]
    panorama = read_back(file_of(tmp_path / "scan.e57", images), tmp_path / "in")["image_0000.png"]
    assert panorama.crop_ltwh == (0, 16, 128, 32)
    mask = panorama.load_mask()
    assert mask[17:47].all()
    assert not mask[:16].any()
    assert not mask[48:].any()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"imageWidth": None}, "imageWidth is missing"),
        ({"pixelWidth": 0.0}, "its size is 128×64 px of 0×"),
        ({"pixelWidth": 0.2}, "no part of an equirectangular panorama"),
        ({"pngImage": None}, "neither a JPEG nor a PNG"),
    ],
)
def test_an_image_that_cannot_be_used_is_named(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    images = [{"name": "a", "sphericalRepresentation": sphere(PICTURE, **changes)}]
    with pytest.raises(InputError, match=problem):
        list_panoramas(file_of(tmp_path / "scan.e57", images))


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    images = [{"sphericalRepresentation": sphere(PICTURE), "pose": pose_at(float(idx))} for idx in range(2)]
    path = file_of(tmp_path / "scan.e57", images)
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 255
    path.write_bytes(bytes(data))
    first = list_panoramas(path)[0][0]
    with pytest.raises(InputError, match=r"scan.e57: cannot be read as E57 \(.*\). Copy it") as found:
        read_picture(path, first.name)
    assert "\n" not in str(found.value)


def test_files_without_panoramas_or_poses_say_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "text.e57").write_text("no")
    with pytest.raises(InputError, match=r"text.e57: cannot be read as E57"):
        list_panoramas(tmp_path / "text.e57")
    cameras = file_of(tmp_path / "scan.e57", [{"pinholeRepresentation": {"imageWidth": 4}}] * 6)
    with pytest.raises(InputError, match=r"contains 0 spherical images; .* 6 images of a pinhole camera are not used"):
        list(list_items(SourceParams(path=cameras)))
    bare = file_of(tmp_path / "bare.e57", [{"sphericalRepresentation": sphere(PICTURE)}] * 2)
    ctx = Context(np.random.default_rng(0), tmp_path)
    with pytest.raises(InputError, match="has poses of 0 images of this capture"):
        poses_e57(read_back(bare, tmp_path / "in"), PosesParams(path=bare), ctx)
    half = {"rotation": {"w": 0.6, "x": 0.0, "y": 0.0, "z": 0.8}, "translation": {"x": 1.2, "y": 3.4, "z": 5.6}}
    same = [{"sphericalRepresentation": sphere(PICTURE), "pose": pose} for pose in (pose_at(1.2, 3.4, 5.6), half)]
    still = file_of(tmp_path / "still.e57", same)
    with pytest.raises(InputError, match="all 2 panoramas are in the same place"):
        poses_e57(read_back(still, tmp_path / "again"), PosesParams(path=still), ctx)
    turned = {
        "sphericalRepresentation": sphere(PICTURE),
        "pose": {"rotation": {"w": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}},
    }
    with pytest.raises(InputError, match="a quaternion of length 0"):
        list_panoramas(file_of(tmp_path / "turned.e57", [turned]))
