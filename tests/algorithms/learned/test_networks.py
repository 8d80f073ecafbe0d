"""The networks on ONNX Runtime: the same results as on PyTorch, on any sphere, from whole files only."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.learned import aliked, networks
from pano_mvs.algorithms.learned.aliked import extract_aliked, level_tiles, maxima_of_scores
from pano_mvs.algorithms.learned.lightglue import LightGlue, match_learned
from pano_mvs.algorithms.learned.networks import DIGESTS, PACKAGED, TILE_PX, Networks
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import angle_between, ray_grid, roll_panorama, rotate_panorama, rotation_from_rotvec
from pano_mvs.scene import Features
from tests.algorithms.learned.colmap_networks import EXTRACTOR, MATCHER

UP = np.array([0.0, -1.0, 0.0])
SIZE, COUNT = (512, 1024), 800


@pytest.fixture(scope="module")
def by_torch() -> Mapping[str, Any]:
    """What PyTorch found on two pictures, written by tools/export_networks.py."""
    return dict(np.load(Path(__file__).parent / "by_torch.npz"))


@pytest.fixture(scope="module")
def panorama(by_torch: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A full sphere of the first picture: a cube whose level sides show it turned by quarters."""
    rays = ray_grid(SIZE)
    side = np.rint(np.arctan2(rays[..., 0], rays[..., 2]) / (np.pi / 2)).astype(int) % 4
    azimuth = np.arctan2(rays[..., 0], rays[..., 2]) - side * np.pi / 2
    x = np.tan((azimuth + np.pi) % (2 * np.pi) - np.pi)
    y = -rays[..., 1] / np.hypot(rays[..., 0], rays[..., 2])
    pixels = [np.clip((value / 2.2 + 0.5) * TILE_PX, 0, TILE_PX - 1).astype(int) for value in (y, x)]
    pictures = np.stack([np.rot90(by_torch["picture0"], number) for number in range(4)])
    return np.asarray(pictures[side, pixels[0], pixels[1]], np.uint8)


def extracted(picture: NDArray[np.uint8], up: NDArray[np.float64], networks: Networks = PACKAGED) -> Features:
    """Return the key points of the upper one of the two rows of views, which go all the way around."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(aliked, "level_tiles", lambda up: level_tiles(up)[:8])
        return extract_aliked(picture, np.ones(SIZE, np.bool_), ups=[up], max_keypoints=COUNT, networks=networks)


@pytest.fixture(scope="module")
def found(panorama: NDArray[np.uint8]) -> Features:
    return extracted(panorama, UP)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_key_points_and_descriptors_are_those_of_pytorch(by_torch: Mapping[str, Any], number: int) -> None:
    image = (by_torch[f"picture{number}"].astype(np.float32) / 255).transpose(2, 0, 1)[None]
    score, *maps = PACKAGED.load("aliked_detector.onnx")(image=image)
    pixels, strengths = maxima_of_scores(score[0, 0], 0.01)
    expected = by_torch[f"pixels{number}"]
    strongest = pixels[np.argsort(-strengths)[:1100]]
    distances = np.linalg.norm(expected[:, None] - strongest, axis=2).min(axis=1)
    assert np.mean(distances < 0.05) > 0.97
    named = {f"features{level}": one for level, one in enumerate(maps)}
    descriptors = PACKAGED.load("aliked_descriptor.onnx")(**named, pixels=expected[::16])[0]
    cosines = (descriptors * by_torch[f"descriptors{number}"]).sum(axis=1)
    assert np.median(cosines) > 0.999
    assert np.quantile(cosines, 0.05) > 0.98


@pytest.mark.slow
def test_matches_are_those_of_pytorch(by_torch: Mapping[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch ran all layers without dropping key points; stopping early loses few matches.

    A processor also computes what is meant for graphics cards.
    """
    monkeypatch.setattr(networks, "_PROVIDERS", dict.fromkeys(("cpu", "cuda"), "CPUExecutionProvider"))
    theirs = Networks(provider="cuda")
    layer = theirs.load("lightglue_layer.onnx")
    seen = []
    for number in (0, 1):
        image = (by_torch[f"picture{number}"].astype(np.float32) / 255).transpose(2, 0, 1)[None]
        _, *maps = PACKAGED.load("aliked_detector.onnx")(image=image)
        pixels = by_torch[f"pixels{number}"]
        named = {f"features{level}": one for level, one in enumerate(maps)}
        descriptors = PACKAGED.load("aliked_descriptor.onnx")(**named, pixels=pixels)[0]
        seen.append((descriptors, (pixels / (TILE_PX / 2) - 1).astype(np.float32)))
    matches, scores = LightGlue(theirs).match(seen[0], seen[1], min_score=0.1)
    ours, expected = {(int(i), int(j)) for i, j in matches}, {(int(i), int(j)) for i, j in by_torch["matches"]}
    assert len(ours & expected) > 0.9 * len(expected)
    assert len(ours - expected) < 0.1 * len(expected)
    assert scores.min() > 0.1
    nothing = np.zeros((0, 128), np.float32), np.zeros((0, 2), np.float32)
    assert len(LightGlue(theirs).match(nothing, seen[1], min_score=0.1)[0]) == 0
    assert layer.interface == PACKAGED.load("lightglue_layer.onnx").interface


def test_level_tiles_cover_the_horizon_and_follow_the_zenith() -> None:
    turn = rotation_from_rotvec([0.3, 1.0, -0.2])
    tiles = level_tiles(turn @ UP)
    azimuth = np.linspace(-np.pi, np.pi, 50)
    for elevation in np.deg2rad([-30.0, 0.0, 30.0]):
        level = [
            np.sin(azimuth) * np.cos(elevation),
            np.full(50, -np.sin(elevation)),
            np.cos(azimuth) * np.cos(elevation),
        ]
        rays = np.stack(level, axis=1) @ turn.T
        assert np.any([tile.contains(tile.pixels_from_rays(rays)) for tile in tiles], axis=0).all()
    for tile in tiles:
        assert tile.view_from_cam[0] @ (turn @ UP) == pytest.approx(0, abs=1e-9), "it does not roll"
        assert tile.view_from_cam[1] @ (turn @ UP) < -0.9


def turned(features: Features, other: Features, new_from_old: NDArray[np.float64]) -> tuple[int, float]:
    """Return the number of matches with a turned camera, and the share of them that shows the same place."""
    matches = match_learned(features, other)
    off = angle_between(features.bearings[matches[:, 0]] @ new_from_old.T, other.bearings[matches[:, 1]])
    return len(matches), float(np.mean(off < np.deg2rad(0.5)))


@pytest.mark.slow
def test_a_rolled_panorama_has_the_rolled_key_points(panorama: NDArray[np.uint8], found: Features) -> None:
    """No view's centre is where it was, and what was on the seam is not."""
    rolled, new_from_old = roll_panorama(panorama, 200)
    other = extracted(rolled, UP)
    count, right = turned(found, other, new_from_old)
    assert count > 0.27 * COUNT
    assert right > 0.97
    near_seam = found.bearings @ np.array([0.0, 0.0, -1.0]) > np.cos(np.deg2rad(15))
    matched = match_learned(found, other, max_views=24)[:, 0]
    assert np.mean(near_seam[matched]) > 0.7 * np.mean(near_seam)


@pytest.mark.slow
def test_a_tilted_camera_is_levelled_by_its_zenith(panorama: NDArray[np.uint8], found: Features) -> None:
    tilt = rotation_from_rotvec([0.5, 0.0, -0.6])
    picture = rotate_panorama(panorama, tilt)
    other = extracted(picture, tilt @ UP)
    count, right = turned(found, other, tilt)
    assert count > 0.27 * COUNT
    assert right > 0.97


@pytest.mark.slow
def test_the_record_is_valid_and_leaves_out_masked_pixels(
    panorama: NDArray[np.uint8], found: Features, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aliked, "level_tiles", lambda up: level_tiles(up)[:8])
    found.check()
    assert found.learned == len(found) == COUNT
    assert np.all(found.descriptors == np.rint(found.descriptors))
    assert np.linalg.norm(found.descriptors, axis=1) == pytest.approx(networks.DESCRIPTOR_NORM, rel=0.01)
    mask = np.ones(SIZE, np.bool_)
    mask[:, 400:600] = False
    rest = extract_aliked(panorama, mask, ups=[UP])
    azimuth = np.arctan2(rest.bearings[:, 0], rest.bearings[:, 2]) / (2 * np.pi) + 0.5
    assert not np.any((azimuth > 400 / 1024) & (azimuth < 600 / 1024))


def test_a_plain_panorama_has_no_key_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aliked, "level_tiles", lambda up: level_tiles(up)[:1])  # of 16, which all show the same
    plain = extract_aliked(np.full((*SIZE, 3), 90, np.uint8), np.ones(SIZE, np.bool_), ups=[UP], threshold=0.1)
    plain.check()
    assert len(plain) == 0


def test_key_points_of_other_stages_cannot_be_matched(
    panorama: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aliked, "level_tiles", lambda up: level_tiles(up)[:1])
    found = extract_aliked(panorama, np.ones(SIZE, np.bool_), ups=[UP], max_keypoints=100)
    assert len(found) == 100
    others = replace(found, learned=0)
    with pytest.raises(UsageError, match=r"features\.aliked"):
        match_learned(others, others)
    assert match_learned(found, others).shape == (0, 2)  # an image without texture


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    with resources.as_file(resources.files("pano_mvs.algorithms.learned") / "models") as folder:
        shutil.copytree(folder, tmp_path / "models")
    return tmp_path / "models"


def test_files_of_ones_own_are_used_and_checked(copied: Path) -> None:
    Networks(models=copied).check()
    file = copied / "lightglue_start.onnx"
    whole = file.read_bytes()
    file.write_bytes(whole[:2000])
    with pytest.raises(UsageError, match=r"lightglue_start\.onnx.*damaged"):
        Networks(models=copied).check()
    shutil.copy(copied / "lightglue_end.onnx", file)
    with pytest.raises(UsageError, match=r"lightglue_start\.onnx must have descriptors"):
        Networks(models=copied).check()
    file.unlink()
    with pytest.raises(UsageError, match=r"lightglue_start\.onnx: this network is missing"):
        Networks(models=copied).check()


@pytest.fixture
def colmap(tmp_path: Path) -> Path:
    """A folder with small networks in COLMAP's form, under any names."""
    for source, name in ((EXTRACTOR, "aliked-n16rot.onnx"), (MATCHER, "aliked-lightglue.onnx")):
        shutil.copy(source, tmp_path / name)
    return tmp_path


@pytest.mark.slow
def test_files_of_colmap_find_and_match_key_points(panorama: NDArray[np.uint8], colmap: Path) -> None:
    theirs = Networks(models=colmap)
    theirs.check()
    rolled, new_from_old = roll_panorama(panorama, 128)
    first, second = (extracted(one, UP, theirs) for one in (panorama, rolled))
    first.check()
    matches = match_learned(first, second, networks=theirs, min_score=0.99)
    off = angle_between(first.bearings[matches[:, 0]] @ new_from_old.T, second.bearings[matches[:, 1]])
    assert len(matches) > COUNT / 15
    assert np.mean(off < np.deg2rad(0.2)) > 0.9  # half a pixel is 0.06°
    plain = extracted(np.zeros((*SIZE, 3), np.uint8), UP, theirs)
    assert match_learned(plain, first, networks=theirs).shape == (0, 2)


def test_a_folder_with_some_files_of_colmap_is_reported(colmap: Path) -> None:
    second = shutil.copy(colmap / "aliked-n16rot.onnx", colmap / "aliked-n32.onnx")
    with pytest.raises(UsageError, match=r"one extractor in COLMAP's form, but has aliked-n16rot.onnx and aliked-n32"):
        Networks(models=colmap).check()
    Path(second).unlink()
    matcher = (colmap / "aliked-lightglue.onnx").rename(colmap / "kept.bin")
    with pytest.raises(UsageError, match=r"one matcher in COLMAP's form, but has none"):
        Networks(models=colmap).check()
    shutil.copy(Path(__file__).parent / "grey.onnx", matcher.with_name("aliked-lightglue.onnx"))
    with pytest.raises(UsageError, match="has none"):
        Networks(models=colmap).check()
    (colmap / "aliked-n16rot.onnx").unlink()
    with pytest.raises(UsageError, match=r"this network is missing.*or take aliked-n16rot\.onnx"):
        Networks(models=colmap).check()


def test_a_damaged_file_of_the_package_is_reported(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = copied / next(iter(DIGESTS))
    content = bytearray(file.read_bytes())
    content[1000] ^= 1
    file.write_bytes(content)
    monkeypatch.setattr(networks, "_PACKAGED", copied)
    with pytest.raises(UsageError, match="damaged"):
        PACKAGED.check()


def test_a_provider_that_is_not_installed_is_reported() -> None:
    with pytest.raises(UsageError, match="'directml' is not in the installed ONNX Runtime, which has cpu"):
        Networks(provider="directml").check()
