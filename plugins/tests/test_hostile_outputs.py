"""Commands over the output of a run write and read only below their folders, whatever its files state."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pano_mvs_evaluation.ranges.error_picture import write_depth_pictures
from pano_mvs_evaluation.ranges.evaluate import evaluate_depth
from pano_mvs_page.maps import run_plans
from pano_mvs_page.share import share_run
from pano_mvs_viewer.shown_scene import open_scene

import pano_mvs.io
import pano_mvs.report
import pano_mvs.results
import pano_mvs.session
from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import item_problem
from pano_mvs.geometry import Rigid3, quat_wxyz_from_rotation
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.house_file import read_house
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.poses.metashape import write_metashape
from pano_mvs.io.poses.other_json import write_openmvg
from pano_mvs.io.rig_calibration import read_rig
from pano_mvs.report.page import gather_report, write_page
from pano_mvs.results.run_output import load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import FilePart, Poses
from pano_mvs.scene.image_file import write_png
from pano_mvs.session.merging.merge import merge_outputs
from tests.algorithms.blocks.walked_blocks import some_world
from tests.hostile_names import HOSTILE_NAMES, LONG_NAMES, contents
from tests.session.merging.written_blocks import SIZE_HW, write_block


def _colmap(out: Path, poses: Poses) -> None:
    write_colmap_model(out / "colmap/sparse/0", poses, dict.fromkeys(poses.names, SIZE_HW))


def _numbers(pose: Rigid3, separator: str = " ", *, translation_first: bool = False) -> str:
    quaternion, translation = quat_wxyz_from_rotation(pose.rotation).tolist(), pose.translation.tolist()
    return separator.join(map(repr, (translation + quaternion) if translation_first else (quaternion + translation)))


def _colmap_text(out: Path, poses: Poses) -> None:
    _colmap(out, poses)
    model = out / "colmap/sparse/0"
    rows = [f"{idx} {_numbers(pose)} 1 {name}\n\n" for idx, (name, pose) in enumerate(poses.cameras.items(), 1)]
    (model / "images.txt").write_text("".join(rows))
    (model / "cameras.txt").write_text(f"1 EQUIRECTANGULAR {SIZE_HW[1]} {SIZE_HW[0]} 64 32\n")
    (model / "points3D.txt").write_text("")
    for path in model.glob("*.bin"):
        path.unlink()


def _transforms(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    frames = []
    for name, pose in poses.cameras.items():
        world_from_opengl = np.eye(4)
        world_from_opengl[:3] = np.column_stack([pose.rotation.T @ np.diag([1.0, -1.0, -1.0]), pose.center])
        frames.append({"panorama": name, "transform_matrix": world_from_opengl.tolist()})
    (out / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))


def _poses_json(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    views = [
        {"image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()}
        for name, pose in poses.cameras.items()
    ]
    (out / "poses.json").write_text(json.dumps({"views": views}))


def _csv(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    rows = [f"{name},{_numbers(pose, ',', translation_first=True)}" for name, pose in poses.cameras.items()]
    (out / "poses.csv").write_text("\n".join(["name,tx,ty,tz,qw,qx,qy,qz", *rows]))


def _opensfm(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    shots = {
        name: {"camera": "c", "rotation": [0.0, 0.0, 0.0], "translation": pose.translation.tolist()}
        for name, pose in poses.cameras.items()
    }
    cameras = {"c": {"projection_type": "spherical"}}
    (out / "reconstruction.json").write_text(json.dumps([{"cameras": cameras, "shots": shots}]))


def _openmvg(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    write_openmvg(out / "sfm_data.json", poses, dict.fromkeys(poses.names, SIZE_HW))


def _alicevision(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    views, placed = [], []
    for number, (name, pose) in enumerate(poses.cameras.items()):
        views.append({"viewId": str(number), "poseId": str(number), "intrinsicId": "0", "path": name})
        transform = {"rotation": pose.rotation.T.ravel().tolist(), "center": pose.center.tolist()}
        placed.append({"poseId": str(number), "pose": {"transform": transform}})
    cameras = [{"intrinsicId": "0", "type": "equirectangular"}]
    scene = {"version": ["1", "2", "3"], "views": views, "intrinsics": cameras, "poses": placed}
    (out / "cameras.sfm").write_text(json.dumps(scene))


def _metashape(out: Path, poses: Poses) -> None:
    shutil.rmtree(out / "colmap/sparse")
    text = replace(poses, names=tuple(name.translate(_NOT_XML) for name in poses.names))
    write_metashape(out / "cameras.xml", text, dict.fromkeys(text.names, SIZE_HW), file_from_world=np.eye(3))


_NOT_XML = {ord(sign): "" for sign in "\x07\x1b"}
SECRET = b"what nobody may read"
FORMATS: dict[str, Callable[[Path, Poses], None]] = {
    "io.colmap.reader.read_colmap_model": _colmap,
    "io.colmap.reader.read_colmap_model (text)": _colmap_text,
    "io.poses.json_files.transforms_poses": _transforms,
    "io.poses.json_files.read_posed_views": _poses_json,
    "io.poses.files.read_csv": _csv,
    "io.poses.other_json.opensfm_poses": _opensfm,
    "io.poses.other_json.openmvg_poses": _openmvg,
    "io.poses.other_json.alicevision_poses": _alicevision,
    "io.poses.metashape.read_metashape": _metashape,
}
"""Reader of poses to what writes a file for it. A new reader is added here."""

_BY_WAY_OF_THESE = {
    *(f"io.poses.files.{name}" for name in ("read_poses", "read_groups")),
    *(f"io.colmap.reader.{name}" for name in ("read_cameras", "read_images", "read_points")),
    *("io.truth.read_truth", "io.truth.read_cameras"),  # names of poses, matched with those of images
    *("io.poses.trajectories.read_trajectory", "io.poses.positions.read_positions"),  # likewise; never from an output
}
_OTHERS = {  # readers of files that state names, with the test of them; the readers of arrays and pictures state none
    "results.run_output.load": "test_hostile_names_in_run_json_name_no_file",
    "session.merging.files.load_blocks": "test_commands_write_nothing_for_hostile_names",
    "pano_mvs_viewer.shown_scene.open_scene": "test_commands_write_nothing_for_hostile_names",
    "pano_mvs_page.maps.run_plans": "test_hostile_names_of_floor_plans_are_left_out",
    "io.ranges.keys_of_npz": "test_arrays_of_an_archive_are_not_names_of_files",
    "io.house_file.read_house": "test_hostile_names_of_a_house_are_refused",
    "io.rig_calibration.read_rig": "test_hostile_names_of_lenses_are_refused",
}
_NO_NAMES = {
    *("pano_mvs_page.sharing.open_in_browser", "pano_mvs_queues.queues.read_queue"),
    "pano_mvs_video.video_files.read_times",
    *(f"io.ply.{name}" for name in ("read_ply", "read_ply_mesh", "read_ply_points", "open_ply_points")),
    *(f"io.ranges.read_{name}" for name in ("range_tiff", "normals", "confidence_png", "npy")),
    *("io.ranges.read_npz", "io.colmap.workspace.read_colmap_map"),
    *("io.images.metadata.read_container", "io.transforms_json.open_mask", "io.meshes.read_glb"),
    *("io.poses.json_files.read_json_value", "session.merging.block_runs.open_blocks", "session.session.open_session"),
    "session.code_listing.read_code_listing",  # names of functions, which are only shown
}


def test_every_reader_is_here() -> None:
    known = {name.partition(" ")[0] for name in FORMATS} | _BY_WAY_OF_THESE | _OTHERS.keys() | _NO_NAMES
    core = (pano_mvs.io, pano_mvs.results, pano_mvs.report, pano_mvs.session)
    plugins = [import_module(path.name) for path in sorted(Path(__file__).parents[1].glob("*/pano_mvs_*"))]
    found = set()
    for package in (*core, *(plugin for plugin in plugins if plugin.__name__ not in _SEPARATE)):
        root = Path(package.__path__[0])
        for path in root.rglob("*.py"):
            module = ".".join([package.__name__, *path.relative_to(root).with_suffix("").parts])
            for function in re.findall(r"^def (\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE):
                name = f"{module.removeprefix('pano_mvs.')}.{function}"
                if re.fullmatch(_READER, name):
                    found.add(name)
    assert found == known
    assert set(_OTHERS.values()) <= globals().keys()


_SEPARATE = {"pano_mvs_example", "pano_mvs_las", "pano_mvs_torch"}
_READER = r"io\..*\.\w+_poses|.*\.((read|load|open)(_\w+)?|run_plans|keys_of_npz)"


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hostile") / "runs"
    for number, chosen in enumerate((range(6), range(2, 8))):
        write_block(root / f"block_{number}", list(chosen), some_world(number))
    return root


@pytest.mark.parametrize("reader", FORMATS)
@pytest.mark.parametrize("name", HOSTILE_NAMES + LONG_NAMES)
def test_hostile_names_of_poses_are_refused(blocks: Path, tmp_path: Path, name: str, reader: str) -> None:
    """Hostile names are refused, or what they name is a file below the folder of images."""
    block = tmp_path / "block"
    (block / "colmap/sparse/0").mkdir(parents=True)
    shutil.copy(blocks / "block_0/run.json", block)
    poses = load(blocks / "block_0").poses
    assert poses is not None
    FORMATS[reader](block, replace(poses, names=(*poses.names[:-1], name)))
    if (cameras := block / "cameras.xml").exists():  # these are read only by their own name, and matched with images
        assert match_image_names(poses.names, read_poses(cameras).cameras).keys() <= set(poses.names)
        return
    try:
        found = load(block).poses
    except InputError as error:
        assert "its name" in str(error)  # noqa: PT017  # some formats state the folder by itself
        return
    assert found is not None
    assert "openmvg" in reader or "alicevision" in reader
    assert not [name for name in found.names if item_problem(name)]


def test_commands_write_nothing_for_hostile_names(blocks: Path, tmp_path: Path) -> None:
    """`merge` wrote range maps two folders above its output."""
    runs = tmp_path / "deep" / "runs"
    shutil.copytree(blocks, runs)
    (tmp_path / "secret.png").write_bytes(SECRET)
    block = runs / "block_0"
    poses = load(block).poses
    assert poses is not None
    _colmap(block, replace(poses, names=(*poses.names[:-1], "../../secret.png")))
    before = contents(tmp_path)
    commands: tuple[Callable[[], object], ...] = (
        lambda: merge_outputs([block, runs / "block_1"], runs / "merged"),
        lambda: share_run(load(block), runs / "page", images=runs),
    )
    for command in commands:
        with pytest.raises(InputError, match=r"its name"):
            command()
    assert all(camera.picture is None for camera in open_scene(block, images=runs).cameras)
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_hostile_names_in_run_json_name_no_file(blocks: Path, tmp_path: Path) -> None:
    """A preview of any name was copied into the result of `merge`."""
    names = HOSTILE_NAMES[:4]
    runs = tmp_path / "deep" / "runs"
    shutil.copytree(blocks, runs)
    (tmp_path / "secret.png").write_bytes(SECRET)
    block = runs / "block_0"
    value = json.loads((block / "run.json").read_bytes())
    for view, name in zip(value["views"], names, strict=False):
        view |= {"preview": name}
    value["views"] += [{"name": name, "preview": name} for name in names]
    value["poses"]["registered"] += names
    value["poses"]["rejected"] = value["poses"]["doubts"] = dict.fromkeys(names, "it repeats")
    value["files"] = value["left_over"] = dict.fromkeys(names, "0" * 64)
    value["failures"] = [{"stage": "images", "item": name, "cause": "it is damaged", "log": name} for name in names]
    value["stages"] = [{"name": "images", "use": "source.folder", "params": {"path": str(runs)}}]
    (block / "run.json").write_text(json.dumps(value))
    outside = contents(tmp_path)
    run = load(block)
    assert [run.views[view].image for view in names] == [None] * len(names)
    assert all(view.preview is None and view.image is None for view in run.views.values())
    merged, page = runs / "merged", runs / "page"
    merge_outputs([block, runs / "block_1"], merged)
    share_run(run, page)
    write_page(merged, run.summary, gather_report(block, run.summary, StoredValues()))
    written = [path for path in contents(tmp_path) if not path.startswith((str(merged), str(page)))]
    assert written == list(outside)
    assert not [data for data in contents(runs).values() if data and SECRET in data]


@pytest.mark.parametrize("name", [name for name in HOSTILE_NAMES if name not in {"..", "a/nul"}])
def test_arrays_of_an_archive_are_not_names_of_files(tmp_path: Path, name: str) -> None:
    """Pictures of errors were written under the names of the arrays of an archive."""
    ranges = np.full((8, 16), 2.0, np.float32)
    arrays: dict[str, Any] = {name.removesuffix(".png"): ranges}
    np.savez(tmp_path / "ranges.npz", **arrays)
    out = tmp_path / "deep" / "errors"
    out.mkdir(parents=True)
    before = contents(tmp_path)
    try:
        evaluation = evaluate_depth(tmp_path / "ranges.npz", tmp_path / "ranges.npz")
    except InputError:
        return
    with pytest.raises(InputError, match="its name"):
        write_depth_pictures(out, evaluation)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", HOSTILE_NAMES + LONG_NAMES)
def test_hostile_names_of_floor_plans_are_left_out(blocks: Path, tmp_path: Path, name: str) -> None:
    runs = tmp_path / "deep" / "runs"
    shutil.copytree(blocks, runs)
    (tmp_path / "secret.png").write_bytes(SECRET)
    block = runs / "block_0"
    (block / "floor_plan").mkdir()
    storey = {"png": name, "floor": 0.0, "cut": 1.0, "corner": [0, 0], "size_px": [4, 4], "metres_per_pixel": 1.0,
              "rooms": [{}]}  # fmt: skip
    about = {"file_from_world": np.eye(3).tolist(), "storeys": [storey]}
    (block / "floor_plan/floor_plan.json").write_text(json.dumps(about))
    plans, note = run_plans(load(block), Rigid3.identity())
    assert plans == []
    assert "floor_plan.json was left out" in note


def test_links_of_a_floor_plan_do_not_lead_outside(blocks: Path, tmp_path: Path) -> None:
    block = tmp_path / "block"
    shutil.copytree(blocks / "block_0", block)
    (block / "floor_plan").mkdir()
    write_png(tmp_path / "secret.png", np.zeros((4, 4, 3), np.uint8))
    (block / "floor_plan/plan.png").symlink_to(tmp_path / "secret.png")
    about = {"file_from_world": np.eye(3).tolist(), "storeys": [{"png": "plan.png", "rooms": [{}]}]}
    (block / "floor_plan/floor_plan.json").write_text(json.dumps(about))
    assert "a link leads outside" in run_plans(load(block), Rigid3.identity())[1]


@pytest.mark.parametrize("name", HOSTILE_NAMES + LONG_NAMES)
def test_hostile_names_of_lenses_are_refused(tmp_path: Path, name: str) -> None:
    """Pictures of lenses are found by the names of the lenses."""
    lens = {"size_px": [64, 64], "focal_px": [20, 20], "centre_px": [32, 32], "distortion": [0, 0, 0, 0]}
    rig = {"model": "opencv_fisheye", "first_pixel_px": 0.5, "lenses": {"front": lens, name: lens}}
    path = tmp_path / "rig.yaml"
    path.write_text(json.dumps(rig))
    with pytest.raises(InputError, match=r"the name .* of a lens must consist of letters|rig.yaml:1:"):
        read_rig(FilePart(path))


@pytest.mark.parametrize("name", HOSTILE_NAMES + LONG_NAMES)
def test_hostile_names_of_a_house_are_refused(tmp_path: Path, name: str) -> None:
    """Pictures of a page are found by the names of the panoramas."""
    row = {"name": name, "placed_by": "links", "part": 0, "group": None, "scale": 1.0, "center": [0, 0, 0],
           "rotation": np.eye(3).tolist(), "center_std": None, "turn_std_deg": None, "links": []}  # fmt: skip
    path = tmp_path / "house.json"
    path.write_text(json.dumps({"camera_height": 1.5, "panoramas": [row]}))
    with pytest.raises(InputError, match=r"house\.json"):
        read_house(path)
