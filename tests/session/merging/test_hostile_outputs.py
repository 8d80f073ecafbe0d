"""Commands over the output of a run write and read only below their folders, whatever its files state."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.evaluation.ranges.error_picture import write_depth_pictures
from pano_mvs.evaluation.ranges.evaluate import evaluate_depth
from pano_mvs.geometry import Rigid3, quat_wxyz_from_rotation
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.report.page import gather_report, write_page
from pano_mvs.results.run_output import load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Poses
from pano_mvs.session.merging.merge import merge_outputs
from pano_mvs.share.share import share_run
from pano_mvs.viewer.shown_scene import open_scene
from tests.algorithms.blocks.walked_blocks import some_world
from tests.hostile_names import HOSTILE_NAMES
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


SECRET = b"what nobody may read"
FORMATS: tuple[Callable[[Path, Poses], None], ...] = (
    *(_colmap, _colmap_text, _transforms, _poses_json, _csv, _opensfm),
)


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return all files and folders below a folder, and the bytes of the files."""
    found = sorted(folder.rglob("*"))
    return {str(path): path.read_bytes() if path.is_file() else None for path in found}


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hostile") / "runs"
    for number, chosen in enumerate((range(6), range(2, 8))):
        write_block(root / f"block_{number}", list(chosen), some_world(number))
    return root


@pytest.mark.parametrize("write", FORMATS)
@pytest.mark.parametrize("name", HOSTILE_NAMES)
def test_hostile_names_of_poses_are_refused(
    blocks: Path, tmp_path: Path, name: str, write: Callable[[Path, Poses], None]
) -> None:
    block = tmp_path / "block"
    (block / "colmap/sparse/0").mkdir(parents=True)
    shutil.copy(blocks / "block_0/run.json", block)
    poses = load(blocks / "block_0").poses
    assert poses is not None
    write(block, replace(poses, names=(*poses.names[:-1], name)))
    with pytest.raises(InputError, match=r"its name"):
        load(block).poses  # noqa: B018


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


@pytest.mark.parametrize("name", HOSTILE_NAMES[:4])
def test_hostile_names_in_run_json_name_no_file(blocks: Path, tmp_path: Path, name: str) -> None:
    """A preview of any name was copied into the result of `merge`."""
    runs = tmp_path / "deep" / "runs"
    shutil.copytree(blocks, runs)
    (tmp_path / "secret.png").write_bytes(SECRET)
    block = runs / "block_0"
    value = json.loads((block / "run.json").read_bytes())
    value["views"][0] |= {"preview": name}
    value["views"].append({"name": name, "preview": name})
    value["poses"]["registered"] += [name]
    value["poses"]["rejected"] = value["poses"]["doubts"] = {name: "it repeats"}
    value["files"] = value["left_over"] = {name: "0" * 64}
    value["failures"] = [{"stage": "images", "item": name, "cause": "it is damaged", "log": name}]
    value["stages"] = [{"name": "images", "use": "source.folder", "params": {"path": str(runs)}}]
    (block / "run.json").write_text(json.dumps(value))
    outside = contents(tmp_path)
    run = load(block)
    assert [run.views[view].image for view in (name,)] == [None]
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
