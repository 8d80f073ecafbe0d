"""The stage poses.localise: a folder of photographs, of which some cannot be used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pano_mvs_photographs.localise_stage import LocaliseParams, localise, localise_memory_bytes
from PIL import Image
from pydantic import ValidationError

from pano_mvs.algorithms.faces.render import face_image
from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import PinholeView, Rigid3, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import Features, FilePart, Panorama, Poses, RangeMap
from pano_mvs.testing.room import default_room, render

SIZE_HW = (192, 384)
CENTERS = {"a.png": (0.0, 0.0, 0.0), "b.png": (0.5, 0.1, 0.2), "unswept.png": (-0.3, 0.0, 0.6)}
TURN = rotation_from_rotvec(np.array([0.1, 0.6, -0.1]))
PHOTO_HW, FOCAL_PX = (240, 320), 250.0

Inputs = tuple[Poses, dict[str, Features], dict[str, RangeMap], dict[str, Panorama]]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    pictures = tmp_path_factory.mktemp("panoramas")
    poses = {name: Rigid3.from_center(np.eye(3), np.array(center)) for name, center in CENTERS.items()}
    features, ranges, images = {}, {}, {}
    for name, pose in poses.items():
        picture, true = render(default_room(), pose, SIZE_HW, supersample=2)
        Image.fromarray(picture).save(pictures / name)
        images[name] = Panorama(FilePart(pictures / name), SIZE_HW, SIZE_HW)
        features[name] = extract_sift(picture, np.ones(SIZE_HW, np.bool_))
        if name != "unswept.png":
            ranges[name] = RangeMap(true.astype(np.float32), np.full(SIZE_HW, 255, np.uint8))
    return Poses.without_points(poses, frame="test", scale="metres", metric=True), features, ranges, images


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "phone"
    folder.mkdir()
    panorama = render(
        default_room(), Rigid3.from_center(np.eye(3), np.array([0.2, 0.1, 0.1])), (512, 1024), supersample=1
    )[0]
    view = PinholeView(TURN, FOCAL_PX, np.array(PHOTO_HW[::-1]) / 2, PHOTO_HW)
    Image.fromarray(face_image(panorama, view)).save(folder / "2.png")
    Image.new("RGB", PHOTO_HW[::-1]).save(folder / "10.jpg")
    (folder / "broken.jpg").write_bytes(b"not a photograph")
    return folder


@pytest.mark.slow
def test_a_folder_is_localised_and_the_rest_is_named(capture: Inputs, folder: Path, tmp_path: Path) -> None:
    ctx = Context(np.random.default_rng(0), tmp_path)
    found = localise(*capture, LocaliseParams(path=folder), ctx)
    found.check()
    assert found.names == ("phone/2.png",), found.rejected
    assert np.degrees(geodesic_angle(found.cam_from_world(0).rotation, TURN)) < 0.2
    assert np.linalg.norm(found.cam_from_world(0).center - [0.2, 0.1, 0.1]) < 0.04
    assert found.focals_px[0] == pytest.approx(FOCAL_PX, rel=0.01)
    assert found.sizes_hw.tolist() == [list(PHOTO_HW)]
    assert found.pictures[0].read_bytes() == (folder / "2.png").read_bytes()
    assert found.rejected.keys() == {"phone/10.jpg", "phone/broken.jpg"}
    assert "only 0 of its 0 key points" in found.rejected["phone/10.jpg"]
    assert "not an image" in found.rejected["phone/broken.jpg"]
    assert ctx.metrics["localised"] == pytest.approx(1 / 3)
    assert "1 of 3 photographs were localised" in ctx.notes
    assert sum("was not localised" in note for note in ctx.notes) == 2


def test_a_single_photograph_is_localised(capture: Inputs, folder: Path, tmp_path: Path) -> None:
    ctx = Context(np.random.default_rng(0), tmp_path)
    assert localise(*capture, LocaliseParams(path=folder / "2.png"), ctx).names == ("2.png",)


@pytest.mark.slow
@pytest.mark.parametrize("block", [1, 32])
def test_photographs_of_a_large_capture_are_localised_in_blocks(
    capture: Inputs, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """Only one of two panoramas is used; `a.png` matches better."""
    poses, features, ranges, images = capture
    monkeypatch.setattr("pano_mvs_photographs.localise_stage._BLOCK", block)
    alone = {"a.png": ranges["a.png"]}
    expected = localise(
        poses, features, alone, images, LocaliseParams(path=folder), Context(np.random.default_rng(0), tmp_path)
    )
    settings = LocaliseParams.model_validate({"path": folder, "candidates": 1})
    found = localise(*capture, settings, Context(np.random.default_rng(0), tmp_path))
    assert found.names == ("phone/2.png",)
    assert found.rejected == expected.rejected
    assert found.rotations.tobytes() == expected.rotations.tobytes()
    assert found.translations.tobytes() == expected.translations.tobytes()


def test_memory_does_not_grow_with_captures_of_more_panoramas_than_are_used() -> None:
    def needed(panoramas: int, **settings: int) -> int:
        params = LocaliseParams.model_validate({"path": "phone", **settings})
        return localise_memory_bytes(params, {"ranges": range(panoramas)})

    assert needed(40) == needed(5000) < 1.5e9
    assert needed(10) < needed(20) < needed(21)
    assert needed(5000, candidates=40) - needed(5000) == needed(80, candidates=40) - needed(40)
    assert needed(5000, candidates=0) > 30e9


def test_an_empty_folder_is_refused_with_the_settings(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    Image.new("L", (8, 8)).save(tmp_path / "masks" / "1.png")
    (tmp_path / "notes.txt").write_text("no photograph")
    with pytest.raises(ValidationError, match="no photographs here"):
        LocaliseParams(path=tmp_path)
    (tmp_path / "lobby").mkdir()
    (tmp_path / "lobby" / "1.JPG").touch()
    assert LocaliseParams(path=tmp_path).path == tmp_path


def test_a_missing_folder_is_named(capture: Inputs, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such folder"):
        localise(*capture, LocaliseParams(path=tmp_path / "nowhere"), Context(np.random.default_rng(0), tmp_path))
