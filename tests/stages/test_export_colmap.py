"""COLMAP's own code on what the stages write: fusion on the CPU, masks, seeds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Names
from pano_mvs.geometry import angle_between, ray_grid
from pano_mvs.io.colmap.workspace import read_colmap_map
from pano_mvs.scene import FilePart, Panorama, Poses, RangeMap
from pano_mvs.scene.files import FaceFiles
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.stages.exports.colmap import (
    DenseInitParams,
    DenseParams,
    FacesParams,
    MasksParams,
    ModelParams,
    colmap,
    colmap_dense,
    colmap_dense_init,
    colmap_faces,
    colmap_masks,
)
from pano_mvs.stages.points import surface, tracked
from pano_mvs.testing.room import capture_poses, default_room, range_along, render
from tests.stored import read_picture
from tools.benchmarks.colmap_dense import deliver, fused_points, wall_distances, write_workspace
from tools.benchmarks.dense_chain import context

SurfaceParams = Registry.installed().stages["points.surface"].params_type
TrackedParams = Registry.installed().stages["points.tracked"].params_type

SIZE = (256, 512)
NAMES = ("a/000.png", "a/b/001.png", "002.jpg")


@dataclasses.dataclass(frozen=True)
class Capture:
    """Three views of the room with true ranges; of the second a disc about the nadir is masked."""

    images: dict[str, Panorama]
    poses: Poses
    ranges: dict[str, RangeMap]


def capture_of(folder: Path, size_hw: tuple[int, int], names: tuple[str, ...], *, masked: bool) -> Capture:
    images, ranges = {}, {}
    cameras = capture_poses(len(names))
    for idx, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        picture, true = render(default_room(), camera, size_hw, supersample=1)
        path = folder / f"{idx}.png"
        write_png(path, picture)
        cut = 30.0 if masked and idx == 1 else 0.0
        images[name] = Panorama(FilePart(path), size_hw, size_hw, nadir_deg=cut)
        known = np.where(images[name].load_mask(), true, np.float32(np.nan))
        ranges[name] = RangeMap(known, np.where(np.isfinite(known), 200, 0).astype(np.uint8))
    poses = Poses.without_points(dict(zip(names, cameras, strict=True)), frame="room", scale="room", metric=False)
    return Capture(images, poses, ranges)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return capture_of(tmp_path_factory.mktemp("room"), SIZE, NAMES, masked=True)


@pytest.fixture(scope="module")
def workspace(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dense")
    return write_workspace(out, capture.images, capture.poses, capture.ranges, points=3000, size_px=120)


@pytest.mark.slow
def test_colmap_fuses_the_workspace_to_the_walls(workspace: Path, capture: Capture) -> None:
    points = fused_points(workspace)
    assert len(points) > 20_000
    cameras = [capture.poses.cam_from_world(idx) for idx in range(3)]
    errors = wall_distances(points, default_room(), cameras)
    assert np.median(errors) < 0.2
    assert np.percentile(errors, 95) < 5
    # Walls, ceiling and floor are all there, seen from every face.
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    assert low == pytest.approx([-3, -1.5, -2.5], abs=0.05)
    assert high == pytest.approx([3, 1.3, 2.5], abs=0.05)


def test_depths_made_for_pixel_centers_would_be_half_a_pixel_off(workspace: Path) -> None:
    """COLMAP's dense code takes the pixel (c, r) for the ray K⁻¹ (c, r, 1); its sparse code has (0, 0) at a corner."""
    model = pycolmap.Reconstruction(workspace / "sparse")
    image = next(image for image in model.images.values() if image.name == "a/000_front.jpg")
    calibration = model.cameras[image.camera_id].calibration_matrix()
    depth = read_colmap_map(workspace / "stereo/depth_maps/a/000_front.jpg.geometric.bin")
    row, column = np.indices(depth.shape)
    ray = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(calibration).T
    length = np.linalg.norm(ray, axis=-1)
    true = range_along(default_room(), np.zeros(3), (ray / length[..., None]).reshape(-1, 3)).reshape(depth.shape)
    assert np.median(np.abs(depth * length / true - 1)) < 1e-4


def test_every_file_of_a_picture_is_where_colmap_looks(workspace: Path) -> None:
    names = [
        f"{item}_{face}.jpg"
        for item in ("a/000", "a/b/001", "002")
        for face in ("front", "right", "back", "left", "up", "down")
    ]
    assert (workspace / "stereo/fusion.cfg").read_text().split() == names
    for folder in ("sparse", "sparse/0"):
        model = pycolmap.Reconstruction(workspace / folder)
        assert sorted(image.name for image in model.images.values()) == sorted(names)
    for name in names:
        picture, mask = (
            read_picture(workspace / "images" / name),
            read_picture(workspace / f"masks/{name}.png", cv2.IMREAD_GRAYSCALE),
        )
        assert picture.shape == (120, 120, 3)
        assert mask.shape == (120, 120)
        assert read_colmap_map(workspace / f"stereo/depth_maps/{name}.geometric.bin").shape == (120, 120)
        normals = read_colmap_map(workspace / f"stereo/normal_maps/{name}.geometric.bin")
        length = np.linalg.norm(normals, axis=-1)
        assert (np.isclose(length, 1, atol=1e-3) | (length == 0)).all()


def test_what_is_masked_has_no_depth_and_no_point(workspace: Path, capture: Capture) -> None:
    names = [path.relative_to(workspace / "masks").as_posix() for path in (workspace / "masks").rglob("*.png")]
    assert len(names) == 18
    for name in names:
        mask = read_picture(workspace / "masks" / name, cv2.IMREAD_GRAYSCALE)
        depth = read_colmap_map(workspace / "stereo/depth_maps" / name.replace(".png", ".geometric.bin"))
        assert (depth[mask == 0] == 0).all()
        assert (mask == 0).any() == (name in {"a/b/001_down.jpg.png"})
    model = pycolmap.Reconstruction(workspace / "sparse")
    masked = next(image for image in model.images.values() if image.name == "a/b/001_down.jpg")
    mask = read_picture(workspace / "masks/a/b/001_down.jpg.png", cv2.IMREAD_GRAYSCALE)
    for point in masked.points2D:
        x, y = np.floor(point.xy).astype(int)
        assert mask[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].any()
    assert len(fused_points(workspace, masks=True)) > 20_000


def test_no_file_of_a_face_depends_on_what_is_masked(capture: Capture, tmp_path: Path) -> None:
    image, ranges = capture.images[NAMES[1]], capture.ranges[NAMES[1]]
    picture = read_picture(image.image.path)
    picture[~image.load_mask()] = (255, 0, 255)
    cv2.imwrite(str(tmp_path / "painted.png"), picture)
    painted = dataclasses.replace(image, image=FilePart(tmp_path / "painted.png"))
    params = FacesParams.model_validate({"size_px": 60})
    one, other = (
        colmap_faces(image=panorama, range_map=ranges, params=params, ctx=context(tmp_path / name))
        for name, panorama in (("a", image), ("b", painted))
    )
    assert len(one.files) == 24
    for target, path in one.files.items():
        assert path.read_bytes() == other.files[target].read_bytes(), target


def test_a_workspace_without_tracked_points_says_that_nothing_is_fused(capture: Capture, tmp_path: Path) -> None:
    cuts = {name: FaceFiles({}, size_px=50) for name in NAMES}
    ctx = context(tmp_path / "scratch")
    colmap_dense(poses=capture.poses, faces=cuts, images=Names(NAMES), points=None, params=DenseParams(), ctx=ctx)
    assert "18 of 18 faces see no point of the model: COLMAP fuses none" in ctx.notes[0]
    assert ctx.metrics["faces_without_points"] == 18


def test_faces_follow_their_settings_and_the_model_follows_the_faces(capture: Capture, tmp_path: Path) -> None:
    params = FacesParams.model_validate({"layout": "octagon", "fov_deg": 70, "size_px": 40, "image_format": "png"})
    ctx = context(tmp_path / "scratch")
    name = NAMES[0]
    cut = colmap_faces(image=capture.images[name], range_map=capture.ranges[name], params=params, ctx=ctx)
    assert "octagon faces of 70° do not cover the sphere" in ctx.notes[0]
    deliver(cut, tmp_path, "a/000")
    model = colmap_dense(
        poses=capture.poses, faces={name: cut}, images=Names(NAMES), points=None, params=DenseParams(), ctx=ctx
    )
    deliver(model, tmp_path, "")
    read = pycolmap.Reconstruction(tmp_path / "colmap_dense/sparse")
    assert (read.num_reg_images(), read.num_frames()) == (10, 1)
    focal_lengths = [camera.focal_length_x for camera in read.cameras.values()]
    assert focal_lengths == pytest.approx([20 / np.tan(np.radians(35))] * 10)
    for image in read.images.values():
        assert image.name.startswith("a/000_")
        assert image.name.endswith(".png")
        assert read_picture(tmp_path / "colmap_dense/images" / image.name).shape == (40, 40, 3)


def test_pictures_that_differ_in_their_extension_alone_stay_apart(capture: Capture, tmp_path: Path) -> None:
    poses = Poses.without_points(
        dict(zip(("1.jpg", "1.png"), capture_poses(2), strict=True)), frame="", scale="", metric=False
    )
    ctx = context(tmp_path / "scratch")
    cuts = {name: FaceFiles({}, size_px=50) for name in poses.names}
    colmap_dense(poses=poses, faces=cuts, images=Names(poses.names), points=None, params=DenseParams(), ctx=ctx)
    model = pycolmap.Reconstruction(tmp_path / "scratch/sparse")
    assert {"1.jpg_front.jpg", "1.png_front.jpg"} < {image.name for image in model.images.values()}


@pytest.mark.slow
def test_seeds_are_points_with_tracks_in_the_panoramas(capture: Capture, tmp_path: Path) -> None:
    ctx = context(tmp_path / "scratch")
    samples = {
        name: surface(image=capture.images[name], range_map=capture.ranges[name], params=SurfaceParams(), ctx=ctx)
        for name in NAMES
    }
    points = tracked(
        poses=capture.poses,
        samples=samples,
        ranges=capture.ranges,
        params=TrackedParams.model_validate({"count": 4000}),
        ctx=ctx,
    )
    seeds = colmap_dense_init(
        poses=capture.poses, points=points, images=capture.images, params=DenseInitParams(format="both"), ctx=ctx
    )
    deliver(seeds, tmp_path, "")
    model = pycolmap.Reconstruction(tmp_path / "colmap_dense_init/sparse/0")
    assert model.num_points3D() == 4000
    assert model.num_reg_images() == 3
    assert model.compute_mean_track_length() > 2.5
    assert 0 < model.compute_mean_reprojection_error() < 0.5
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert (camera.model_name, list(camera.params)) == ("EQUIRECTANGULAR", [512, 256])
        picture, mask = capture.images[image.name].load(), capture.images[image.name].load_mask()
        x, y = np.array([point.xy for point in image.points2D]).T
        rays = np.array([image.cam_from_world() * model.points3D[p.point3D_id].xyz for p in image.points2D])
        found = np.array([camera.cam_ray_from_img(point.xy) for point in image.points2D])
        assert angle_between(found, rays).max() < 1e-6
        row, column = np.minimum(y.astype(int), 255), x.astype(int) % 512
        assert mask[row, column].mean() > 0.995, "what is masked is not seen, but for what lies on its rim"
        colors = np.array([model.points3D[point.point3D_id].color for point in image.points2D], float)
        assert np.median(np.abs(colors - picture[row, column])) < 25


def test_too_few_points_are_told(capture: Capture, tmp_path: Path) -> None:
    ctx = context(tmp_path / "scratch")
    name = NAMES[0]
    few = surface(
        image=capture.images[name],
        range_map=capture.ranges[name],
        params=SurfaceParams.model_validate({"count": 100}),
        ctx=ctx,
    )
    points = tracked(poses=capture.poses, samples={name: few}, ranges=capture.ranges, params=TrackedParams(), ctx=ctx)
    assert 50 < len(points) <= 100
    assert f"only {len(points)} of 100000 points" in ctx.notes[0]


@pytest.mark.parametrize("source_hw", [(256, 512), (600, 1200), (128, 256)])
def test_masks_are_called_and_sized_as_colmap_wants_them(
    capture: Capture, tmp_path: Path, source_hw: tuple[int, int]
) -> None:
    image = dataclasses.replace(capture.images[NAMES[1]], source_size_hw=source_hw)
    ctx = context(tmp_path / "scratch")
    files = colmap_masks(image=image, params=MasksParams(), ctx=ctx)
    assert list(files.files) == ["colmap/masks/{name}.png"]
    mask = read_picture(next(iter(files.files.values())), cv2.IMREAD_UNCHANGED)
    assert mask.shape == source_hw
    down = ray_grid(source_hw)[..., 1] > np.cos(np.radians(30))
    assert (mask[down] == 0).all()
    assert (mask == 0).mean() == pytest.approx(1 / 6, abs=0.01)
    assert ctx.metrics["masked_share"] == pytest.approx(1 / 6, abs=0.01)


def test_cropped_pictures_are_written_as_the_spheres_that_the_cameras_are(capture: Capture, tmp_path: Path) -> None:
    whole = capture.images[NAMES[0]]
    write_png(tmp_path / "crop.png", whole.load()[40:200, 100:400])
    image = Panorama(FilePart(tmp_path / "crop.png"), SIZE, SIZE, crop_ltwh=(100, 40, 300, 160))
    ctx = context(tmp_path / "scratch")
    files = colmap_masks(image=image, params=MasksParams(pictures=True), ctx=ctx)
    assert set(files.files) == {"colmap/masks/{name}.png", "colmap/images/{name}"}
    picture = decode_image(files.files["colmap/images/{name}"])
    mask = read_picture(files.files["colmap/masks/{name}.png"], cv2.IMREAD_UNCHANGED)
    assert picture.shape == (*SIZE, 3)
    assert (mask > 0).sum() == 300 * 160
    np.testing.assert_array_equal(picture[40:200, 100:400], whole.load()[40:200, 100:400])


@pytest.mark.parametrize(("form", "told"), [("bin", False), ("both", True)])
def test_names_with_blanks_are_told_where_the_text_cannot_hold_them(
    capture: Capture, tmp_path: Path, form: Literal["bin", "txt", "both"], told: bool
) -> None:
    """COLMAP itself writes such names into images.txt and reads them back as far as the blank."""
    poses = Poses.without_points({"a/1 b.png": capture.poses.cam_from_world(0)}, frame="", scale="", metric=False)
    images, ctx = {"a/1 b.png": capture.images[NAMES[0]]}, context(tmp_path / "scratch")
    files = colmap(poses=poses, images=images, photographs=None, params=ModelParams(format=form), ctx=ctx)
    assert bool(ctx.notes) == told
    assert {Path(target).suffix for target in files.files} == ({".bin", ".txt"} if form == "both" else {".bin"})
    deliver(files, tmp_path, "")
    model = pycolmap.Reconstruction(tmp_path / "colmap/sparse/0")
    assert [image.name for image in model.images.values()] == ["a/1 b.png"]


@pytest.mark.slow
def test_true_ranges_fuse_to_the_walls_at_full_size(tmp_path: Path) -> None:
    """The bar: 1024×512, six faces of 96° and 200 px; median ≤ 2 mm, 95 % ≤ 10 mm at 3 m."""
    capture = capture_of(tmp_path, (512, 1024), tuple(f"{idx}.png" for idx in range(3)), masked=False)
    folder = write_workspace(tmp_path / "out", capture.images, capture.poses, capture.ranges, fov_deg=96, size_px=200)
    points = fused_points(folder)
    errors = wall_distances(points, default_room(), capture_poses(3))
    assert len(points) > 50_000
    assert np.median(errors) <= 2 / 20
    assert np.percentile(errors, 95) <= 10 / 10
