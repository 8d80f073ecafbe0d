"""Copies of panoramas are found, however they were turned, resized or saved, and other panoramas are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import pano_mvs
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.copies import find_copies
from pano_mvs.stages.source import FolderParams, list_folder
from pano_mvs.testing.room import default_room, render

SIZE_HW = (256, 512)


def room_seen_from(*center: float) -> NDArray[np.uint8]:
    return render(default_room(), Rigid3.from_center(np.eye(3), np.array(center)), SIZE_HW, supersample=1)[0]


@pytest.fixture(scope="module")
def picture() -> NDArray[np.uint8]:
    return room_seen_from(0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))


@pytest.mark.parametrize(
    ("columns", "scale", "quality", "brightness"), [(0, 1.0, 40, 1.0), (128, 1.0, 90, 1.0), (77, 0.5, 80, 0.7)]
)
def test_copies_are_found_with_their_turn(
    tmp_path: Path, picture: NDArray[np.uint8], columns: int, scale: float, quality: int, brightness: float
) -> None:
    turned = cv2.resize(np.roll(picture, -columns, axis=1), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    paths = [tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.jpg"]
    cv2.imwrite(str(paths[0]), room_seen_from(0.6, 0.0, 0.2))
    cv2.imwrite(str(paths[1]), picture)
    cv2.imwrite(str(paths[2]), (turned * brightness).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    for _ in range(2):  # the second time from the user's cache
        found = find_copies({path.name: path for path in paths})
        assert list(found) == ["c.jpg"]
        assert found["c.jpg"].original == "b.png"
        assert found["c.jpg"].turn_deg == pytest.approx(360 * columns / 512, abs=1.5)


def test_an_hdr_picture_is_a_copy_of_the_one_that_was_made_from_it(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    paths = [tmp_path / "a.jpg", tmp_path / "b.hdr"]
    cv2.imwrite(str(paths[0]), picture)
    cv2.imwrite(str(paths[1]), (1e3 * (picture / 255) ** 2.2).astype(np.float32))
    assert list(find_copies({path.name: path for path in paths})) == ["b.hdr"]


@pytest.mark.parametrize("step", [0.1, 0.3])
def test_panoramas_side_by_side_are_no_copies(tmp_path: Path, picture: NDArray[np.uint8], step: float) -> None:
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    cv2.imwrite(str(paths[0]), picture)
    cv2.imwrite(str(paths[1]), room_seen_from(step, 0.0, 0.0))
    assert find_copies({path.name: path for path in paths}) == {}


def test_plain_and_damaged_pictures_are_no_copies(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.png" for name in "abcd"]
    for path in paths[:2]:
        cv2.imwrite(str(path), np.full((32, 64, 3), 200, np.uint8))
    for path in paths[2:]:
        path.write_bytes(b"no picture")
    assert find_copies({path.name: path for path in paths}) == {}


def test_the_source_names_copies_and_uses_each_picture_once(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    cv2.imwrite(str(folder / "1.png"), picture)
    cv2.imwrite(str(folder / "2.png"), np.roll(picture, -128, axis=1))
    params = FolderParams.model_validate({"path": folder})
    with pytest.raises(InputError, match=r"all images are copies of one \(1\.png\)"):
        list(list_folder(params))
    cv2.imwrite(str(folder / "3.png"), room_seen_from(0.6, 0.0, 0.2))
    problems = {item.name: item.problem for item in list_folder(params)}
    copied = "it is a copy of 1.png, turned by 90°, which is used alone, as a copy adds nothing; remove one of them"
    assert problems == {"1.png": "", "2.png": copied, "3.png": ""}


@pytest.mark.slow
def test_a_plan_does_not_read_pictures_for_copies(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    paths = {name: tmp_path / name for name in ("a.png", "b.png")}
    for path in paths.values():
        cv2.imwrite(str(path), picture)
    assert find_copies(paths, read=False) == {}
    assert list(find_copies(paths)) == ["b.png"]
    assert list(find_copies(paths, read=False)) == ["b.png"]
    folder = tmp_path / "images"
    folder.mkdir()
    for number, center in enumerate(((0.6, 0.0, 0.2), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
        cv2.imwrite(str(folder / f"{number}.png"), room_seen_from(*center))
    settings: dict[str, Any] = {"cache": tmp_path / "cache", "out": tmp_path / "out", "until": ["images"]}
    assert list(pano_mvs.plan("fast", images=folder, **settings)["images"].run) == ["0.png", "1.png", "2.png"]
    pano_mvs.run("fast", images=folder, **settings)
    assert list(pano_mvs.plan("fast", images=folder, **settings)["images"].cached) == ["0.png", "1.png"]


def test_what_an_earlier_command_could_not_read_is_read_again(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    paths = {name: tmp_path / name for name in ("a.png", "b.png", "c.png")}
    for path in paths.values():
        cv2.imwrite(str(path), picture)
    assert find_copies(paths, max_pixels=1000) == {}
    assert {name: copy.original for name, copy in find_copies(paths).items()} == {"b.png": "a.png", "c.png": "a.png"}
