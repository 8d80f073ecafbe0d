"""Images and masks are used only with the bytes that were listed, and are read once for that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pano_mvs.api import FilePart, SourceItem
from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import ChangedFileError, InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import Panorama
from pano_mvs.scene.image_file import write_png
from pano_mvs.stages.source import FolderParams, folder, list_folder
from tests.stored import read_picture


@pytest.fixture
def item(tmp_path: Path) -> SourceItem:
    """An image with a mask, as the engine hands it out."""
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png", "masks/a.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), rng.integers(1, 255, (32, 64, 3), dtype=np.uint8))
    first = next(iter(list_folder(FolderParams(path=tmp_path, masks=tmp_path / "masks"))))
    assert sorted(first.files) == ["image", "mask"]
    return replace(first, digests={role: digest_from_file(path) for role, path in first.files.items()})


def read(item: SourceItem) -> Panorama:
    context = Context(np.random.default_rng(0), Path(), 1)
    made = folder(item, FolderParams(path=item.files["image"].parent), context)
    assert isinstance(made, Panorama)
    return made


@pytest.mark.parametrize("use", [read, lambda item: read(item).load()], ids=["listed", "loaded"])
def test_files_are_read_once(
    item: SourceItem, use: Callable[[SourceItem], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: Counter[str] = Counter()
    original = Path.read_bytes

    def counted(path: Path) -> bytes:
        reads[path.name if path.parent.name != "masks" else "mask"] += 1
        return original(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    use(item)
    times = 1 if use is read else 2  # the source, then `load`
    assert reads == {"a.png": times, "mask": times}


@pytest.mark.parametrize("role", ["image", "mask"])
def test_file_that_is_not_the_listed_one_is_refused(item: SourceItem, role: str) -> None:
    panorama = read(item)
    assert panorama.image.digest
    path = item.files[role]
    other = read_picture(path)
    other[0, 0] ^= 1
    cv2.imwrite(str(path), other)
    with pytest.raises(ChangedFileError, match=rf"{path.name} changed during the run; run again") as caught:
        read(item)
    assert caught.value.path == path
    with pytest.raises(ChangedFileError, match=rf"{path.name} changed during the run; run again"):
        panorama.load()
    path.unlink()
    with pytest.raises(InputError, match=rf"{path.name}: cannot be read \(No such file"):
        panorama.load()


def test_a_part_without_a_digest_is_read_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    assert FilePart(tmp_path / "a", external=True).read_bytes() == b"1"
    with pytest.raises(InputError, match="cannot be read"):
        FilePart(tmp_path / "a\0b").read_bytes()


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


def read_folder(photos: Path, **settings: object) -> tuple[dict[str, Panorama], list[str]]:
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
    found, notes = read_folder(capture / "photos", masks=capture / "masks")
    assert {name: masked_rows(panorama) for name, panorama in found.items()} == dict(zip(NAMES, (3, 5, 0), strict=True))
    assert "3.png has no mask in masks; all of it is used" in notes
    found, notes = read_folder(capture / "photos", masks=capture / "masks", mask=shared, nadir_deg=45, zenith_deg=20)
    rows = {name: masked_rows(panorama) for name, panorama in found.items()}
    assert rows == dict(zip(NAMES, (3 + 4, 5 + 4, 6 + 4), strict=True))  # the lowest quarter is 45°
    assert not any("mask" in note for note in notes)


def test_masks_among_the_pictures_are_no_pictures(capture: Path) -> None:
    write_mask(capture / "photos" / "no people" / "3.png.png")
    shared = write_mask(capture / "photos" / "shared.png")
    found, _ = read_folder(capture / "photos", masks=capture / "photos" / "no people", mask=shared)
    assert sorted(found) == sorted(NAMES)


def test_a_folder_of_masks_that_was_not_given_is_noted(capture: Path) -> None:
    write_mask(capture / "photos" / "masks" / "3.png")
    found, notes = read_folder(capture / "photos")
    assert sorted(found) == sorted(NAMES)
    assert any("masks is there, but not used" in note for note in notes)
    _, notes = read_folder(capture / "photos", masks=capture / "photos" / "masks")
    assert not any("not used" in note for note in notes)


def test_masks_that_fit_no_picture_are_named(capture: Path) -> None:
    (capture / "masks").mkdir()
    with pytest.raises(InputError, match=r"masks: no mask in it belongs .* \(it is empty\)"):
        read_folder(capture / "photos", masks=capture / "masks")
    for name in ("x/a/2.png", "b.png"):
        write_mask(capture / "masks" / name)
    expected = r"\(it holds b\.png and 1 more\)\. The mask of 3\.png must be called 3\.png\.png, or 3\.png$"
    with pytest.raises(InputError, match=expected):
        read_folder(capture / "photos", masks=capture / "masks")
    with pytest.raises(InputError, match="must be a folder"):
        read_folder(capture / "photos", masks=capture / "masks" / "b.png")


def test_a_mask_of_another_shape_is_refused_at_once(capture: Path) -> None:
    with pytest.raises(InputError, match=r"shared\.png: the mask has 32×20 px"):
        read_folder(capture / "photos", mask=write_mask(capture / "shared.png", (20, 32)))


def test_any_resolution_will_do_and_all_that_is_masked_is_told(capture: Path) -> None:
    shared = write_mask(capture / "shared.png", (160, 320), masked=slice(0, 41))
    found, notes = read_folder(capture / "photos", mask=shared)
    assert {masked_rows(panorama) for panorama in found.values()} == {5}
    assert not any("masked" in note for note in notes)
    _, notes = read_folder(capture / "photos", mask=write_mask(shared, masked=slice(0, 16)))
    assert "3.png: everything in it is masked" in notes


def test_transparent_pixels_are_masked(capture: Path) -> None:
    """Pixels that an editor had made transparent were used with the colours that they hold."""
    for name, alphas in {"3.png": (0, 255), "a/2.png": (255, 255), "a/1.jpg.png": (0, 0)}.items():
        picture = np.dstack([read_picture(capture / "photos" / name), np.full((16, 32), alphas[1], np.uint8)])
        picture[:5, :, 3] = alphas[0]
        cv2.imwrite(str(capture / "photos" / name), picture)
    found, notes = read_folder(capture / "photos")
    assert {name: masked_rows(panorama) for name, panorama in found.items()} == dict(zip(NAMES, (0, 0, 5), strict=True))
    assert "{count} images have transparent pixels, which are ignored like masked ones" in notes
    assert "a/1.jpg.png: all of it is transparent, so its alpha channel was not used as a mask" in notes
    assert not any("alpha channel that is not read" in note for note in notes)
    Image.new("LA", (32, 16)).save(capture / "photos" / "4.tif")
    assert any("alpha channel that is not read" in note for note in read_folder(capture / "photos")[1])
    (capture / "photos" / "4.tif").unlink()
    write_mask(capture / "masks" / "3.png", masked=slice(4, 7))
    found, _ = read_folder(capture / "photos", masks=capture / "masks", nadir_deg=20)
    assert masked_rows(found["3.png"]) == 7 + 2, "both masks and the cap count"


def test_transparent_pixels_of_a_stereo_panorama_are_those_of_the_eye_that_is_used(capture: Path) -> None:
    picture = np.full((32, 32, 4), 255, np.uint8)
    picture[:3, :, 3] = picture[20:, :, 3] = 0
    cv2.imwrite(str(capture / "photos" / "3.png"), picture)
    found, _ = read_folder(capture / "photos", stereo="top_bottom")
    assert masked_rows(found["3.png"]) == 3


@pytest.mark.parametrize("masked", [slice(0, 7), slice(2, 14)])
def test_masks_that_hide_most_say_what_their_values_mean(capture: Path, masked: slice) -> None:
    """With inverted masks, which hid 78 % of the sphere, the advice was to take panoramas closer together."""
    write_mask(capture / "masks" / "3.png", masked=masked)
    _, notes = read_folder(capture / "photos", masks=capture / "masks")
    warned = [
        note for note in notes if "masks that hide most of what they show. 0 (black) in a mask means ignored" in note
    ]
    assert len(warned) == (masked.start > 0)
