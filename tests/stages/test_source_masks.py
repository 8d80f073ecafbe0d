"""The masks of source.folder: which file masks which picture, and what is said where none fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import Panorama
from pano_mvs.scene.image_file import write_png
from pano_mvs.stages.source import FolderParams, folder, list_folder

NAMES = ("a/1.jpg.png", "a/2.png", "3.png")  # the first could be the mask of a/1.jpg


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Three pictures of 16×32, each of one colour."""
    for idx, name in enumerate(NAMES):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.full((16, 32, 3), 50 + 50 * idx, np.uint8))
    return tmp_path


def write_mask(path: Path, size_hw: tuple[int, int] = (16, 32), *, masked: slice = slice(0, 8)) -> Path:
    mask: NDArray[np.uint8] = np.full(size_hw, 255, np.uint8)
    mask[masked] = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, mask)
    return path


def read(photos: Path, **settings: object) -> tuple[dict[str, Panorama], list[str]]:
    params = FolderParams.model_validate({"path": photos, **settings})
    context = Context(np.random.default_rng(0), photos, 1)
    items = list(list_folder(params))
    found = {item.name: folder(item, params, context) for item in items}
    return found, [note for item in items for note in item.notes] + context.notes


def masked_rows(panorama: Panorama) -> int:
    valid = panorama.load_mask()
    assert (valid.all(axis=1) | ~valid.any(axis=1)).all()
    return int((~valid.any(axis=1)).sum())


def test_masks_are_found_by_both_names_and_the_shared_one_serves_the_rest(capture: Path) -> None:
    write_mask(capture / "masks" / "a/1.jpg.png.png", masked=slice(0, 3))
    write_mask(capture / "masks" / "a/2.png", masked=slice(0, 4))
    write_mask(capture / "masks" / "a/2.png.png", masked=slice(0, 5))
    shared = write_mask(capture / "shared.png", masked=slice(0, 6))
    found, notes = read(capture / "photos", masks=capture / "masks")
    assert {name: masked_rows(panorama) for name, panorama in found.items()} == dict(zip(NAMES, (3, 5, 0), strict=True))
    assert "3.png has no mask in masks; all of it is used" in notes
    found, notes = read(capture / "photos", masks=capture / "masks", mask=shared, nadir_deg=45, zenith_deg=20)
    rows = {name: masked_rows(panorama) for name, panorama in found.items()}
    assert rows == dict(zip(NAMES, (3 + 4, 5 + 4, 6 + 4), strict=True))  # the lowest quarter is 45°
    assert not any("mask" in note for note in notes)


def test_masks_among_the_pictures_are_no_pictures(capture: Path) -> None:
    write_mask(capture / "photos" / "no people" / "3.png.png")
    shared = write_mask(capture / "photos" / "shared.png")
    found, _ = read(capture / "photos", masks=capture / "photos" / "no people", mask=shared)
    assert sorted(found) == sorted(NAMES)


def test_a_folder_of_masks_that_was_not_given_is_noted(capture: Path) -> None:
    write_mask(capture / "photos" / "masks" / "3.png")
    found, notes = read(capture / "photos")
    assert sorted(found) == sorted(NAMES)
    assert any("masks is there, but not used" in note for note in notes)
    _, notes = read(capture / "photos", masks=capture / "photos" / "masks")
    assert not any("not used" in note for note in notes)


def test_masks_that_fit_no_picture_are_named(capture: Path) -> None:
    (capture / "masks").mkdir()
    with pytest.raises(InputError, match=r"masks: no mask in it belongs .* \(it is empty\)"):
        read(capture / "photos", masks=capture / "masks")
    for name in ("x/a/2.png", "b.png"):
        write_mask(capture / "masks" / name)
    expected = r"\(it holds b\.png and 1 more\)\. The mask of 3\.png must be called 3\.png\.png, or 3\.png$"
    with pytest.raises(InputError, match=expected):
        read(capture / "photos", masks=capture / "masks")
    with pytest.raises(InputError, match="must be a folder"):
        read(capture / "photos", masks=capture / "masks" / "b.png")


def test_a_mask_of_another_shape_is_refused_at_once(capture: Path) -> None:
    with pytest.raises(InputError, match=r"shared\.png: the mask has 32×20 px"):
        read(capture / "photos", mask=write_mask(capture / "shared.png", (20, 32)))


def test_any_resolution_will_do_and_all_that_is_masked_is_told(capture: Path) -> None:
    shared = write_mask(capture / "shared.png", (160, 320), masked=slice(0, 41))
    found, notes = read(capture / "photos", mask=shared)
    assert {masked_rows(panorama) for panorama in found.values()} == {5}
    assert not any("masked" in note for note in notes)
    _, notes = read(capture / "photos", mask=write_mask(shared, masked=slice(0, 16)))
    assert "3.png: everything in it is masked" in notes
