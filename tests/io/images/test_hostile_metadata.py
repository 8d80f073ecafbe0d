"""Valid containers with hostile values in their fields: EXIF, GPano in XMP, and boxes of HEIC, AVIF and MP4 files.

A picture is described, or refused by an error that names it; nothing else is raised, and nothing huge is allocated.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pano_mvs.api import Context, InputError
from pano_mvs.io.images.metadata import (
    camera_from_exif,
    focal_from_exif,
    orientation_from_exif,
    position_from_exif,
    read_container,
)
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
NUMBERS = st.sampled_from([0, 1, 2, 7, 8, 0x7F, 0xFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1]) | st.integers(0, 2**32 - 1)
TAGS = st.sampled_from([0x0112, 0x8769, 0x8825, 0xA405, 700, 256, 257, *range(7)]) | st.integers(0, 0xFFFF)
PLAIN = "nan -inf 1e308 -1e308 1e-320 2e9 -1 0 0.5 64 128 4096 8192 1e9 0x40 ١٢٨ 1_000 true equirectangular cylindrical"
TEXTS = st.sampled_from(["", " ", "128 px", "\U0001f600", "9" * 400, "9" * 5000, *PLAIN.split()]) | st.text(
    st.characters(codec="utf-8", exclude_characters="<&>\"'\0", exclude_categories=["Cc", "Cs"]), max_size=8
)
FIELDS = [*full_sphere(1, 2), "PoseHeadingDegrees", "PosePitchDegrees", "PoseRollDegrees"]


@st.composite
def hostile_exif(draw: st.DrawFn) -> bytes:
    """Return a TIFF of three directories one behind the other, whose fields have any types, counts and values."""
    order, is_big = draw(st.sampled_from("<>")), draw(st.booleans())
    head = {"<": b"II", ">": b"MM"}[order]
    word, entry, count_form = ("Q", "HHQQ", "Q") if is_big else ("I", "HHII", "H")
    data = head + (struct.pack(order + "HHHQ", 43, 8, 0, 16) if is_big else struct.pack(order + "HI", 42, 8))
    for _ in range(3):
        entries = draw(st.lists(st.tuples(TAGS, st.integers(0, 20), NUMBERS, NUMBERS), max_size=4))
        stated = draw(st.just(len(entries)) | st.sampled_from([0, 1000, 0xFFFF]))
        inside = draw(st.booleans())
        data += struct.pack(order + count_form, stated)
        for tag, kind, count, value in entries:
            data += struct.pack(
                order + entry, tag, kind, count % 4 if inside else count, value % 80 if inside else value
            )
        data += struct.pack(order + word, 0)
    return data + bytes(32)


@pytest.mark.slow
@given(hostile_exif())
@settings(max_examples=100, deadline=None)
def test_any_exif_is_read(data: bytes) -> None:
    position = position_from_exif(data)
    assert position is None or (abs(position[0]) <= 90 and abs(position[1]) <= 180)
    assert 1 <= orientation_from_exif(data) <= 8
    focal = focal_from_exif(data, (64, 128))
    assert focal is None or focal > 0
    assert isinstance(camera_from_exif(data), str)
    read_container(data)


@cache
def plain(suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, picture((64, 128)))[1])


def with_packet(kind: str, packet: bytes) -> bytes:
    """Return a picture with an XMP packet, in the way of its container."""
    data = plain(f".{kind}")
    if kind == "jpg":
        return data[:2] + app1(b"http://ns.adobe.com/xap/1.0/\0" + packet) + data[2:]
    if kind == "png":
        return data[:33] + png_chunk(b"iTXt", b"XML:com.adobe.xmp" + bytes(5) + packet) + data[33:]
    if kind == "webp":
        chunk = b"XMP " + struct.pack("<I", len(packet)) + packet + bytes(len(packet) % 2)
        return data[:4] + struct.pack("<I", len(data) - 8 + len(chunk)) + data[8:] + chunk
    return data + struct.pack(">I4s", 8 + len(packet), b"uuid") + packet


PAIRS = st.tuples(NUMBERS, NUMBERS)
ANGLES = st.tuples(PAIRS, PAIRS, PAIRS)


@given(st.sampled_from("<>"), ANGLES, ANGLES, PAIRS, st.integers(0, 0xFFFF))
@settings(max_examples=100, deadline=None)
def test_any_position_is_read(order: str, latitude: Any, longitude: Any, altitude: Any, orientation: int) -> None:
    data = exif(order, latitude=latitude, longitude=longitude, altitude=altitude, orientation=orientation)
    position = position_from_exif(data)
    assert position is None or (abs(position[0]) <= 90 and abs(position[1]) <= 180)
    assert 1 <= orientation_from_exif(data) <= 8


KINDS, FORMS = st.sampled_from(["jpg", "png", "webp", "avif"]), st.sampled_from(["element", "attribute"])


@pytest.mark.slow
@given(st.dictionaries(st.sampled_from(FIELDS), TEXTS), KINDS, FORMS)
@example(full_sphere(10**9, 2 * 10**9), "jpg", "element")
@example(full_sphere(32, 64, CroppedAreaLeftPixels=10**30), "png", "element")
@example(
    {"FullPanoWidthPixels": "64", "FullPanoHeightPixels": "", "ProjectionType": ""}
    | {"CroppedAreaImageWidthPixels": "", "CroppedAreaImageHeightPixels": "1e308"},
    "jpg",
    "element",
)
@settings(max_examples=100, deadline=None)
def test_any_gpano_costs_at_most_its_picture(fields: dict[str, object], kind: str, form: str) -> None:
    """A GPano field of 2·10⁹ columns ended the run of all pictures."""
    read_with_neighbours(with_packet(kind, xmp(full_sphere(64, 128) | fields, form=form)), kind)


def read_with_neighbours(data: bytes, suffix: str) -> None:
    """Read a capture with a file between two sound ones; it alone may be refused, and with a reason."""
    with TemporaryDirectory() as name:
        capture = Path(name)
        write_jpeg(capture / "a.jpg", (32, 64))
        write_jpeg(capture / "c.jpg", (48, 96))
        (capture / f"b.{suffix}").write_bytes(data)
        params = FolderParams(path=capture)
        items = list(list_folder(params))
        assert [item.name for item in items] == ["a.jpg", f"b.{suffix}", "c.jpg"]
        for item in items:
            refused = item.problem
            assert not refused or item.name.startswith("b.")
            if not refused:
                # A header may state as many pixels as are allowed.
                assert 0 <= folder_memory_bytes(params, {"item": item}) < params.max_megapixels * 1e6 * 16
                (capture / f".{item.name}").mkdir()
                try:
                    made = folder(item, params, Context(np.random.default_rng(0), capture / f".{item.name}"))
                except InputError as error:
                    refused = str(error)
                else:
                    made.check()
                    assert made.load().shape == (*made.size_hw, 3)
            assert not refused or f"b.{suffix}" in refused
            assert len(refused) < 3000


def test_sizes_that_a_file_cannot_hold_plan_no_memory() -> None:
    tiff = sound_files((32, 64), b"")[2]
    read_with_neighbours(tiff[:20] + b"\x7f" + tiff[21:], "tif")  # the most significant half of the width
    heic = by_pillow((32, 64), "HEIF")
    size, length = heic.index(b"ispe") + 8, heic.index(b"ispe") - 1
    for at, value in ((size, b" "), (size, struct.pack(">II", 32_000, 16_000)), (length, b"\0")):
        read_with_neighbours(heic[:at] + value + heic[at + len(value) :], "heic")


def boxes(data: bytes, start: int = 0, end: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start of the contents and end of all boxes of an ISO file, those inside boxes too."""
    at, end = start, len(data) if end is None else end
    while at + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > end:
            return
        yield kind, at + 8, at + size
        if kind in {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"dinf", b"edts", b"iprp", b"ipco", b"meta", b"iinf"}:
            yield from boxes(data, at + 8 + (4 if kind == b"meta" else 0), at + size)
        at += size


def with_hostile_fields(data: bytes, changes: list[tuple[int, int, int, int]]) -> bytes:
    """Return an ISO file in which words of boxes, or their sizes, are replaced: (box, word, value, width)."""
    changed, found = bytearray(data), list(boxes(data))
    for box, word, value, width in changes:
        kind, start, end = found[box % len(found)]
        at = start - 8 + width * (word % max(1, (min(end, start + 120) - start + 8) // width))
        if kind != b"mdat" and at + width <= len(changed):
            changed[at : at + width] = (value & (256**width - 1)).to_bytes(width, "big")
    return bytes(changed)


CHANGES = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, 40), NUMBERS, st.sampled_from([1, 2, 4, 8])), min_size=1, max_size=3
)


@pytest.mark.slow
@given(CHANGES, st.sampled_from(["avif", "heic"]))
@settings(max_examples=60, deadline=None)
def test_any_boxes_of_a_picture_are_read(changes: list[tuple[int, int, int, int]], kind: str) -> None:
    data = plain(".avif") if kind == "avif" else by_pillow((64, 128), "HEIF")
    read_with_neighbours(with_hostile_fields(data, changes), kind)


@pytest.mark.slow
@given(
    st.integers(0, 3), st.lists(st.tuples(st.integers(0, 599), st.integers(0, 255)), max_size=6), st.integers(8, 9999)
)
@settings(max_examples=60, deadline=None)
def test_any_bytes_of_a_file_are_read(number: int, places: list[tuple[int, int]], length: int) -> None:
    """Sizes, types and offsets of RIFF chunks, TIFF entries and JPEG segments."""
    changed = bytearray(sound_files((40, 80), xmp(full_sphere(40, 80)))[number])
    for place, value in places:
        changed[min(place, len(changed) - 1)] = value
    read_with_neighbours(bytes(changed[:length]), ("jpg", "webp", "tif", "tif")[number])


@given(st.lists(st.tuples(NUMBERS, NUMBERS), max_size=3), hostile_exif())
@settings(max_examples=40, deadline=None)
def test_any_stated_sizes_of_a_picture_are_read(sizes: list[tuple[int, int]], about: bytes) -> None:
    ispe = b"".join(struct.pack(">I4sIII", 20, b"ispe", 0, width, height) for width, height in sizes)
    ftyp = struct.pack(">I4s4sI4s", 20, b"ftyp", b"heic", 0, b"mif1")
    read_with_neighbours(ftyp + ispe + struct.pack(">I4s", 8 + len(about), b"mdat") + b"Exif\0\0" + about, "heic")
