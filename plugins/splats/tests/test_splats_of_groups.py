"""Two rooms that nothing connects: each has files of its own for trainers of splats."""

from __future__ import annotations

import json
from pathlib import Path

import pycolmap
import pytest
from pano_mvs_splats.nerfstudio import NerfstudioParams, nerfstudio
from pano_mvs_splats.splat_bundle import SplatBundleParams, splat_bundle

from pano_mvs.engine.stages.context import Context
from pano_mvs.io.ply import read_ply
from pano_mvs.io.transforms_json import NerfstudioFrame, NerfstudioFrames, SplatFrames
from pano_mvs.testing.tiny_capture import tiny_capture
from tests.synthetic.two_rooms import LARGE, ORDER, SMALL, Rooms, context, fused, placed


@pytest.fixture(scope="module")
def rooms() -> Rooms:
    return Rooms(tiny_capture())


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return context(tmp_path / "stage")


_FRAME = NerfstudioFrame(
    "equirectangular",
    "images/{name}",
    "",
    "",
    (64, 32),
    (32.0, 32.0),
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
)


def test_each_room_of_a_splat_bundle_has_its_own_model(rooms: Rooms, ctx: Context, tmp_path: Path) -> None:
    frames = {name: SplatFrames({}, {}, (_FRAME,), 0.001) for name in ORDER}
    files = splat_bundle(
        frames=frames,
        poses=rooms.poses,
        cloud=fused(rooms),
        points=None,
        photographs=None,
        params=SplatBundleParams(),
        ctx=ctx,
    )
    out = placed(files, tmp_path) / "splat_bundle"
    manifest = json.loads((out / "manifest.json").read_text())
    for number, names in enumerate((LARGE, tuple(SMALL))):
        about = manifest["groups"][number]
        assert about["world"] == rooms.poses.worlds[number].frame
        model = pycolmap.Reconstruction(str(out / about["variants"]["equirectangular"]["colmap"]))
        assert {image.name for image in model.images.values()} == set(names)
        assert len(model.points3D) > 20
        listed = json.loads((out / about["variants"]["equirectangular"]["transforms"]).read_text())
        assert {entry["panorama"] for entry in listed["frames"]} == set(names)
        assert {view["panorama"] for view in manifest["views"] if view["group"] == number} == set(names)


def test_each_room_has_transforms_and_a_seed(rooms: Rooms, ctx: Context, tmp_path: Path) -> None:
    frames = {name: NerfstudioFrames({}, {}, (_FRAME,), 0.001) for name in ORDER}
    cloud = fused(rooms)
    files = nerfstudio(
        frames=frames, poses=rooms.poses, cloud=cloud, photographs=None, params=NerfstudioParams(), ctx=ctx
    )
    out = placed(files, tmp_path) / "nerfstudio" / "equirectangular"
    for number, (names, suffix) in enumerate(((LARGE, ""), (tuple(SMALL), "_1"))):
        document = json.loads((out / f"transforms{suffix}.json").read_text())
        assert {entry["panorama"] for entry in document["frames"]} == set(names)
        assert document["ply_file_path"] == f"seed{suffix}.ply"
        assert document["world_frame"] == rooms.poses.worlds[number].frame
        assert len(read_ply(out / f"seed{suffix}.ply")) == sum(cloud.groups()[number].view_counts >= 2)
