"""export.mesh_textured on a box whose walls have known colours: its files, as other programs read them."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from pano_mvs.api import Context, FilePart, Files, InputError, Panorama, Poses, RangeMap
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.pose_groups import join_groups
from pano_mvs.stages.exports.mesh import TexturedParams, mesh_textured
from tests.algorithms.mesh.box import HALF, WALL_COLORS, capture, poses
from tests.stored import read_picture

SETTINGS = {"triangles": 3000, "texture_px": 256, "cell": 0.1}


@dataclass(frozen=True, eq=False)
class Inputs:
    ranges: dict[str, RangeMap]
    poses: Poses
    images: dict[str, Panorama]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Two panoramas of the box; that of the first camera defines the world, which is tilted."""
    folder = tmp_path_factory.mktemp("box")
    shown = capture([Rigid3.from_center(np.eye(3), pose.center) for pose in poses(2)])
    images, ranges, cams = {}, {}, {}
    for idx, view in enumerate(shown.views):
        name = f"{idx}.png"
        write_png(folder / name, view.picture)
        size = view.picture.shape[0], view.picture.shape[1]
        images[name], cams[name] = Panorama(FilePart(folder / name, external=True), size, size), view.cam_from_world
        assert view.range_map is not None
        ranges[name] = view.range_map
    found = Poses.without_points(cams, frame="the box's", scale="metres", metric=True)
    return Inputs(ranges, found, images)


def run(inputs: Inputs, folder: Path, **settings: object) -> Files:
    folder.mkdir(exist_ok=True)
    params = TexturedParams.model_validate(SETTINGS | settings)
    ctx = Context(np.random.default_rng(0), folder)
    return mesh_textured(inputs.ranges, None, None, inputs.poses, inputs.images, params, ctx)


@pytest.fixture(scope="module")
def delivered(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files under their names, as a run delivers them."""
    out = tmp_path_factory.mktemp("out")
    for target, path in run(inputs, tmp_path_factory.mktemp("scratch")).files.items():
        (out / target).write_bytes(path.read_bytes())
    return out


def test_the_glb_is_upright_and_has_the_colors_of_the_walls(delivered: Path) -> None:
    """The floor, y = +1.2 in the world, is below; each wall has its colour on average."""
    read = trimesh.load(delivered / "mesh_textured.glb", force="mesh", process=False)
    assert isinstance(read, trimesh.Trimesh)
    np.testing.assert_allclose(np.abs(read.vertices).max(axis=0), HALF, atol=0.1)
    assert isinstance(read.visual, trimesh.visual.TextureVisuals)
    colored: Any = read.visual.to_color()  # type: ignore[no-untyped-call]  # trimesh
    colors = colored.vertex_colors[:, :3].astype(int)
    floor = (read.vertices[:, 1] < -HALF[1] + 0.1) & (np.abs(read.vertices[:, [0, 2]]) < 1.0).all(axis=1)
    assert floor.sum() >= 3
    assert np.abs(np.median(colors[floor], axis=0) - WALL_COLORS[3]).max() <= 12
    right = (read.vertices[:, 0] > HALF[0] - 0.1) & (np.abs(read.vertices[:, [1, 2]]) < 0.6).all(axis=1)
    assert np.abs(np.median(colors[right], axis=0) - WALL_COLORS[1]).max() <= 12


def test_the_obj_names_files_that_exist(delivered: Path) -> None:
    lines = (delivered / "mesh_textured.obj").read_text().splitlines()
    material = next(line.split()[1] for line in lines if line.startswith("mtllib"))
    texture = (delivered / material).read_text().split("map_Kd ")[1].strip()
    assert (material, texture) == ("mesh_textured.mtl", "mesh_textured.jpg")
    picture, seen = read_picture(delivered / texture), read_picture(delivered / "mesh_textured_seen.png")
    assert picture.shape[:2] == seen.shape[:2]
    assert set(np.unique(seen)) == {0, 255}
    faces = sum(line.startswith("f ") for line in lines)
    read = trimesh.load(delivered / "mesh_textured.glb", force="mesh", process=False)
    assert isinstance(read, trimesh.Trimesh)
    assert faces == len(read.faces)
    assert 0.8 * 3000 <= faces <= 3000


def test_formats_and_frame_can_be_chosen(inputs: Inputs, tmp_path: Path) -> None:
    files = run(inputs, tmp_path / "x", formats=("obj",), texture_format="png", frame="world").files
    names = {"mesh_textured.obj", "mesh_textured.mtl", "mesh_textured.png", "mesh_textured_seen.png"}
    assert set(files) == names
    rows = [line.split()[1:] for line in files["mesh_textured.obj"].read_text().splitlines() if line.startswith("v ")]
    vertices = np.array(rows, float)
    picture = cv2.imdecode(np.frombuffer(files["mesh_textured.png"].read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert (vertices[:, 1] > HALF[1] - 0.1).sum() > 3


def test_a_group_without_ranges_has_no_mesh_and_a_note_says_so(inputs: Inputs, tmp_path: Path) -> None:
    unseen = replace(inputs.poses, names=tuple(f"unseen-{name}" for name in inputs.images))
    params = TexturedParams.model_validate(SETTINGS | {"formats": ("glb",)})
    ctx = Context(np.random.default_rng(0), tmp_path)
    poses = join_groups([inputs.poses, unseen])
    files = mesh_textured(inputs.ranges, None, None, poses, inputs.images, params, ctx).files
    assert sorted(files) == ["mesh_textured.glb", "mesh_textured_seen.png"]
    assert ctx.notes[0].startswith("no mesh_textured_1.glb: no panorama measured a surface")


@pytest.mark.slow
def test_few_range_maps_are_in_memory_at_once(inputs: Inputs, tmp_path: Path) -> None:
    """The two panoramas three times."""
    alive: weakref.WeakSet[RangeMap] = weakref.WeakSet()
    most = 0

    class Stored(dict[str, RangeMap]):
        def __getitem__(self, name: str) -> RangeMap:
            nonlocal most
            loaded = replace(super().__getitem__(name))
            alive.add(loaded)
            most = max(most, len(alive))
            return loaded

    names = {f"{number}-{name}": name for number in range(3) for name in inputs.images}
    cams = {name: inputs.poses.cam_from_world(inputs.poses.names.index(own)) for name, own in names.items()}
    found = Poses.without_points(cams, frame="the box's", scale="metres", metric=True)
    ranges = Stored({name: inputs.ranges[own] for name, own in names.items()})
    run(Inputs(ranges, found, {name: inputs.images[own] for name, own in names.items()}), tmp_path / "x")
    assert most <= 3


def test_panoramas_without_valid_pixels_are_refused(inputs: Inputs, tmp_path: Path) -> None:
    masked = dict(inputs.images)
    for name, image in inputs.images.items():
        masked[name] = image.with_mask(np.zeros(image.size_hw, np.bool_), tmp_path)
    with pytest.raises(InputError, match="the mesh has no faces"):
        run(Inputs(inputs.ranges, inputs.poses, masked), tmp_path / "dark")
