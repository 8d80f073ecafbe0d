"""LAS, LAZ and E57 hold the cloud, as laspy and pye57 read it, where GPS says that it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import laspy
import numpy as np
import pye57
import pytest
from pano_mvs.api import Context, InputError, Params, PointCloud, Poses, Rigid3, UsageError
from pano_mvs.io import thinning
from pano_mvs.testing.conformance import ContractTest, stage_contract_tests
from pyproj import CRS, Transformer

from pano_mvs_las import e57, las
from pano_mvs_las.stages import CloudParams, LasParams

HERE = "x east, y down, z north, by GPS; origin at the first registered camera (47.5000000°, 8.2500000°, 410.0 m)"


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


def the_poses(frame: str = "the first registered camera") -> Poses:
    return Poses.without_points({"a.jpg": Rigid3.identity()}, frame=frame, scale="", metric=bool(frame))


def written(stage: Any, folder: Path, cloud: PointCloud, poses: Poses, params: Params) -> Path:
    folder.mkdir(exist_ok=True)
    (path,) = stage(cloud, poses, params, Context(np.random.default_rng(0), folder)).files.values()
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
    points = e57_points(written(e57, tmp_path, cloud, the_poses(), CloudParams()))
    x, y, z = cloud.points_in_world.T
    for name, values in (("cartesianX", x), ("cartesianY", z), ("cartesianZ", -y)):
        np.testing.assert_array_equal(points[name], values)
    for name, values in zip(("colorRed", "colorGreen", "colorBlue"), cloud.colors_rgb.T, strict=True):
        np.testing.assert_array_equal(points[name], values)


def test_an_e57_file_has_normals_and_a_map(tmp_path: Path) -> None:
    cloud = a_cloud()
    path = written(e57, tmp_path, cloud, the_poses(HERE), CloudParams())
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


@pytest.mark.parametrize(("stage", "params"), [(las, LasParams), (e57, CloudParams)])
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
    monkeypatch.setattr(thinning, "CHUNK_POINTS", 64)
    again = written(stage, tmp_path / "b", cloud, the_poses(), wanted)
    if stage is las:
        np.testing.assert_array_equal(laspy.read(again).xyz, laspy.read(whole).xyz)
    else:
        np.testing.assert_array_equal(e57_points(again)["cartesianX"], e57_points(whole)["cartesianX"])
    with pytest.raises(InputError, match="no points that could be written"):
        written(stage, tmp_path / "c", cloud, the_poses(), params.model_validate({"min_views": 99}))
