"""Every built-in stage keeps the contract that strangers' stages are held to."""

from __future__ import annotations

from typing import Any

import pytest
from _pytest.mark.structures import ParameterSet

from pano_mvs.algorithms.learned import aliked
from pano_mvs.algorithms.learned.aliked import level_tiles
from pano_mvs.algorithms.structure import room_outlines
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.transforms_json import NerfstudioFrame, NerfstudioFrames, SplatFrames
from pano_mvs.scene.files import LevelPanorama
from pano_mvs.testing.conformance import ContractTest, stage_contract_tests
from tests.algorithms.learned.grey_network import GREY_NETWORK
from tests.synthetic.rig_images import tiny_rig_capture, tiny_rig_panorama
from tests.synthetic.tour_files import tiny_tour
from tests.synthetic.video_files import tiny_video

SETTINGS: dict[str, dict[str, Any]] = {
    "export.floor_plan": {"formats": ["png", "svg", "dxf"]},
    "export.mesh": {"depth": 5},
    "depth.prior": {"network": str(GREY_NETWORK)},
    "poses.from_model": {"path": "{capture}/truth/poses.json"},
    "poses.localise": {"path": "{capture}/phone", "candidates": 1},  # each panorama takes 0.7 s
    "poses.extend": {"path": "{capture}/truth/poses.json"},
    "poses.scale": {"factor": 2.0},
    "source.dual_fisheye": {
        "path": str(tiny_rig_capture() / "images"),
        "calibration": str(tiny_rig_capture() / "rig.yaml"),
        "width": 64,
    },
    "source.tour": {"path": str(tiny_tour())},
    "source.video": {"path": str(tiny_video())},
}
# For the contract alone; recorded results are of the settings above. Cutting a surface open takes half of the time.
SMALLER: dict[str, dict[str, Any]] = {"export.mesh_textured": {"triangles": 500, "texture_px": 256}}
FRAME = NerfstudioFrame(
    "equirectangular", "images/{name}", "", "", (64, 32), (32.0, 32.0), ((1, 0, 0), (0, 1, 0), (0, 0, 1))
)
INPUTS: dict[str, dict[str, Any]] = {
    "export.colmap_lenses": {"image": tiny_rig_panorama()},
    "export.nerfstudio": {"frames": {f"{idx:03d}.png": NerfstudioFrames({}, frames=(FRAME,)) for idx in range(4)}},
    "export.tour": {"panoramas": {f"{idx:03d}.png": LevelPanorama({}, "panoramas/{item}.jpg") for idx in range(4)}},
    "features.aliked": {"features": None},  # those of the tiny capture, which the stage returns, too, are everywhere
    "export.splat_bundle": {"frames": {f"{idx:03d}.png": SplatFrames({}, frames=(FRAME,)) for idx in range(4)}},
}
# They run neural networks, render or start a process, half a second or more at each call.
SLOW = (
    "export.floor_plan",
    "export.mesh",
    "export.mesh_textured",
    "features.aliked",
    "features.rooms",
    "masks.operator",
    "poses.localise",
)
# In smaller pictures, a few lines decide how a camera is levelled.
SIZES_HW = {"features.room_lines": (256, 512), "poses.colmap_sift": (96, 192)}


def contract_tests(package: str) -> list[ParameterSet]:
    """Return the tests of each stage that a package, or one below it, defines."""
    stages = Registry.installed().stages
    names = [name for name in sorted(stages) if f"{stages[name].function.__module__}.".startswith(f"{package}.")]
    return [
        pytest.param(contract_test, id=str(contract_test), marks=[pytest.mark.slow] if name in SLOW else [])
        for name in names
        for contract_test in stage_contract_tests(
            stages[name],
            settings=SETTINGS.get(name, {}) | SMALLER.get(name, {}),
            inputs=INPUTS.get(name),
            size_hw=SIZES_HW.get(name, (32, 64)),
        )
    ]


BUILTIN = contract_tests("pano_mvs.stages")
assert len(BUILTIN) > 200


@pytest.fixture(autouse=True)
def few_views(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the network of key points look at one of its 16 views, and outlines of rooms have fewer distances.

    In rolled pictures, a key point is found again in the view beside the one that it was in: those need three. No other
    test uses results of theirs.
    """
    views = 3 if "rolls" in request.node.name else 1
    monkeypatch.setattr(aliked, "level_tiles", lambda up: level_tiles(up)[:views])
    monkeypatch.setattr(room_outlines, "_DISTANCES", room_outlines._DISTANCES[::4])


@pytest.mark.parametrize("contract_test", BUILTIN)
def test_keeps_the_contract(contract_test: ContractTest) -> None:
    contract_test.check()
