"""Metadata of a picture never cost more than that picture, whatever they state."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pano_mvs.api import Context, InputError
from pano_mvs.stages.source import FolderParams, folder, folder_memory_bytes, list_folder
from tests.io.images.pictures import (
    app1,
    by_pillow,
    exif,
    full_sphere,
    picture,
    png_chunk,
    sound_files,
    write_jpeg,
    xmp,
)

pillow_heif.register_heif_opener()
SIZE_HW = (32, 64)
JPEG = bytes(cv2.imencode(".jpg", picture(SIZE_HW))[1])
PNG = bytes(cv2.imencode(".png", picture(SIZE_HW))[1])
SOUND = dict(zip(("jpg", "webp", "tif", "big.tif"), sound_files(SIZE_HW, xmp(full_sphere(*SIZE_HW))), strict=True))
BOXES = {kind: by_pillow(SIZE_HW, kind.upper()) for kind in ("avif", "heif")}
SUFFIXES = {"heif": "heic"}

NUMBERS = st.one_of(
    st.integers(-(10**30), 10**30),
    st.sampled_from([2 * 10**9, 10**9, -1, 0, 1, 31, 32, 63, 64, 65, 128]),
    st.floats(),
    st.sampled_from(["", "1e400", "-0", "0x10", "1/2", "1,5", "٣", "9" * 5000, "nan", "\u202e1", "&lt;", "1_0"]),
)
NAMES = (*full_sphere(1, 1), "PoseHeadingDegrees", "PosePitchDegrees", "PoseRollDegrees", "InitialViewHeadingDegrees")
FIELDS = st.dictionaries(st.sampled_from(NAMES), NUMBERS)


def read_with_neighbours(data: bytes, suffix: str) -> None:
    """Read a capture with a file between two sound ones; it alone may be refused, and with a reason."""
    with tempfile.TemporaryDirectory() as name:
        capture = Path(name)
        write_jpeg(capture / "a.jpg", SIZE_HW)
        write_jpeg(capture / "c.jpg", (64, 128))
        (capture / f"b.{suffix}").write_bytes(data)
        params = FolderParams(path=capture)
        items = list(list_folder(params))
        assert [item.name for item in items] == ["a.jpg", f"b.{suffix}", "c.jpg"]
        for item in items:
            assert not item.problem or item.name.startswith("b.")
            if item.problem:
                continue
            assert 0 <= folder_memory_bytes(params, {"item": item}) < 1 << 30
            scratch = capture / f".{item.name}"
            scratch.mkdir()
            try:
                made = folder(item, params, Context(np.random.default_rng(0), scratch))
            except InputError as error:
                refused = str(error)
                assert f"b.{suffix}" in refused
            else:
                made.check()
                assert made.load().shape == (*made.size_hw, 3)


@given(fields=FIELDS, form=st.sampled_from(["element", "attribute"]), form_of=st.sampled_from(["jpg", "png"]))
@example(fields=full_sphere(10**9, 2 * 10**9), form="element", form_of="jpg")
@example(fields=full_sphere(32, 64, CroppedAreaLeftPixels=10**30), form="element", form_of="png")
@settings(max_examples=60, deadline=None)
def test_any_fields_of_gpano(fields: dict[str, object], form: str, form_of: str) -> None:
    packet = xmp(fields, form=form)
    chunk = png_chunk(b"iTXt", b"XML:com.adobe.xmp" + b"\0" * 5 + packet)
    jpeg = JPEG[:2] + app1(b"http://ns.adobe.com/xap/1.0/\0" + packet) + JPEG[2:]
    read_with_neighbours(jpeg if form_of == "jpg" else PNG[:33] + chunk + PNG[33:], form_of)


@given(
    places=st.lists(st.tuples(st.integers(0, len(exif()) - 1), st.integers(0, 255)), max_size=12), order=st.booleans()
)
@settings(max_examples=60, deadline=None)
def test_any_bytes_in_exif(places: list[tuple[int, int]], order: bool) -> None:
    changed = bytearray(exif("<" if order else ">", orientation=6))
    for place, value in places:
        changed[place] = value
    read_with_neighbours(JPEG[:2] + app1(b"Exif\0\0" + changed) + JPEG[2:], "jpg")


@pytest.mark.slow
@given(data=st.data(), kind=st.sampled_from([*SOUND, *BOXES]))
@settings(max_examples=100, deadline=None)
def test_any_bytes_in_the_boxes_of_a_file(data: st.DataObject, kind: str) -> None:
    """Sizes, types and offsets of ISO boxes, RIFF chunks, TIFF entries and JPEG segments: the first 600 bytes."""
    changed = bytearray((SOUND | BOXES)[kind])
    places = st.integers(0, min(600, len(changed)) - 1)
    for place in data.draw(st.lists(places, min_size=1, max_size=6)):
        changed[place] = data.draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]) | st.integers(0, 255))
    if data.draw(st.booleans()):
        changed = changed[: data.draw(st.integers(8, len(changed)))]
    read_with_neighbours(bytes(changed), SUFFIXES.get(kind, kind.rpartition(".")[2]))


def test_a_width_that_the_file_cannot_hold_plans_no_memory() -> None:
    changed = bytearray(SOUND["tif"])
    changed[20] = 127  # the most significant half of the width
    read_with_neighbours(bytes(changed), "tif")


def test_a_size_that_a_heic_file_cannot_hold_plans_no_memory() -> None:
    changed = bytearray(BOXES["heif"])
    changed[changed.index(b"ispe") + 8] = 32  # the most significant byte of the width
    read_with_neighbours(bytes(changed), "heic")
    changed[changed.index(b"ispe") + 8 : changed.index(b"ispe") + 16] = struct.pack(">II", 32_000, 16_000)
    read_with_neighbours(bytes(changed), "heic")


def test_a_heic_file_without_images_is_refused() -> None:
    changed = bytearray(BOXES["heif"])
    changed[changed.index(b"ispe") - 1] = 0  # the length of the box with the size of its image
    read_with_neighbours(bytes(changed), "heic")


@pytest.mark.parametrize("kind", [*SOUND, *BOXES])
def test_unchanged_files_are_read(kind: str, tmp_path: Path) -> None:
    suffix = SUFFIXES.get(kind, kind.rpartition(".")[2])
    (tmp_path / f"b.{suffix}").write_bytes((SOUND | BOXES)[kind])
    write_jpeg(tmp_path / "a.jpg", (64, 128))
    params = FolderParams(path=tmp_path)
    (item,) = (item for item in list_folder(params) if item.name.startswith("b."))
    assert folder(item, params, Context(np.random.default_rng(0), tmp_path)).source_size_hw == SIZE_HW
