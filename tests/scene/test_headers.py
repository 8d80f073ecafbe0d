"""The headers of picture files, byte by byte: sizes, segments, chunks and directories, whole, cut and damaged."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import ContractError
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.image_header import (
    Entry,
    Segment,
    is_cut_short,
    jpeg_segments,
    open_tiff,
    riff_chunks,
    stated_size,
    stated_size_of_file,
)
from pano_mvs.scene.masking import inside_crop, same_shape


def segment(marker: int, body: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(body) + 2).to_bytes(2, "big") + body


def jpeg_of(*parts: bytes, size: bytes = b"\x08\x00\x30\x00\x50\x03", frame: int = 0xC0) -> bytes:
    return b"\xff\xd8" + b"".join(parts) + segment(frame, size) + segment(0xDA, b"\0\0\0") + b"\x12\x34\xff\xd9"


def test_the_segments_of_a_jpeg_go_up_to_its_first_scan() -> None:
    data = jpeg_of(segment(0xE1, b"Exif"), segment(0xFE, b""))
    found = list(jpeg_segments(data))
    assert found == [Segment(0xE1, 6, 10), Segment(0xFE, 14, 14), Segment(0xC0, 18, 24), Segment(0xDA, 28, 31)]
    assert data[found[0].start : found[0].end] == b"Exif"
    assert not is_cut_short(data)


@pytest.mark.parametrize("between", [b"\xff", b"\xff\xff\xff", b"\xff\x01", b"\xff\xd0\xff\xd7", b"\xff\xd8"])
def test_fill_bytes_and_markers_without_length_are_stepped_over(between: bytes) -> None:
    assert [one.marker for one in jpeg_segments(jpeg_of(between))] == [0xC0, 0xDA]
    assert stated_size(jpeg_of(between)) == (48, 80)


@pytest.mark.parametrize(
    ("data", "markers"),
    [
        (b"", []),
        (b"\xff\xd8", []),
        (b"\x89PNG" + jpeg_of(), []),
        (b"\xff\xd8" + b"x" + jpeg_of()[2:], []),
        (b"\xff\xd8" + segment(0xE1, b"abc") + b"\0" + segment(0xE2, b""), [0xE1]),
        (b"\xff\xd8" + segment(0xE1, b"abc") + b"\xff\xe2\0\x01", [0xE1]),
        (b"\xff\xd8" + segment(0xE1, b"abc") + b"\xff\xe2\0\x02", [0xE1, 0xE2]),
        (b"\xff\xd8" + segment(0xE1, b"abc") + b"\xff\xe2\0\x03", [0xE1]),
        (b"\xff\xd8" + segment(0xE1, b"abc") + b"\xff\xe2\0", [0xE1]),
    ],
)
def test_what_is_damaged_yields_the_segments_before(data: bytes, markers: list[int]) -> None:
    assert [one.marker for one in jpeg_segments(data)] == markers
    assert is_cut_short(data)


@pytest.mark.parametrize("tail", [b"", b"video \xff\xd9"])
def test_a_jpeg_is_whole_if_its_end_marker_follows_the_scan(tail: bytes) -> None:
    thumbnail = segment(0xE1, jpeg_of())  # which has an end marker of its own
    whole = jpeg_of(thumbnail)
    assert not is_cut_short(whole + tail)
    assert is_cut_short(whole[:-1])
    assert is_cut_short(whole[: whole.rfind(b"\x12\x34")])


@pytest.mark.parametrize(
    ("frame", "is_frame"),
    [(0xC0, True), (0xC2, True), (0xCF, True), (0xC4, False), (0xC8, False), (0xCC, False), (0xBF, False)],
)
def test_the_size_is_in_the_start_of_a_frame(frame: int, is_frame: bool) -> None:
    assert stated_size(jpeg_of(frame=frame)) == ((48, 80) if is_frame else None)


def chunk(kind: bytes, body: bytes) -> bytes:
    return kind + len(body).to_bytes(4, "little") + body + bytes(len(body) % 2)


def webp_of(*chunks: bytes) -> bytes:
    return b"RIFF" + bytes(4) + b"WEBP" + b"".join(chunks)


LOSSY = chunk(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", 0x4000 | 300, 0x8000 | 200))
LOSSLESS = chunk(b"VP8L", b"\x2f" + struct.pack("<I", (300 - 1) | (200 - 1) << 14 | 1 << 28))
CANVAS = chunk(b"VP8X", bytes(4) + (70_000 - 1).to_bytes(3, "little") + (90_000 - 1).to_bytes(3, "little"))
ONE_PIXEL = chunk(b"VP8X", bytes(10))


def test_the_chunks_of_a_webp_begin_at_even_places() -> None:
    data = webp_of(chunk(b"ABCD", b"12345"), chunk(b"EFGH", b""), chunk(b"IJKL", b"12"))
    assert list(riff_chunks(data)) == [(b"ABCD", 20, 25), (b"EFGH", 34, 34), (b"IJKL", 42, 44)]
    assert list(riff_chunks(data[:43]))[2] == (b"IJKL", 42, 43)
    assert len(list(riff_chunks(data[:42]))) == 3
    assert len(list(riff_chunks(data[:41]))) == 2


@pytest.mark.parametrize(
    ("data", "size"),
    [
        (webp_of(LOSSY), (200, 300)),
        (webp_of(LOSSLESS), (200, 300)),
        (webp_of(CANVAS, LOSSY), (90_000, 70_000)),
        (webp_of(chunk(b"ICCP", b"123"), LOSSY), (200, 300)),
        (webp_of(ONE_PIXEL), (1, 1)),
        (webp_of(chunk(b"VP8 ", bytes(10)), LOSSLESS), (200, 300)),
        (webp_of(chunk(b"VP8 ", bytes(6) + b"\x05\0\0\0")), None),
        (webp_of(chunk(b"ABCD", b"")), None),
        (webp_of(LOSSY)[:24], None),
        (webp_of(LOSSY).replace(b"WEBP", b"WAVE"), None),
        (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300, 200), (200, 300)),
        (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IDAT", 300, 200), None),
        (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 0, 200), None),
        (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300, 0), None),
        (b"\x89PNG\r\n\x1a\n" + b"\0\0\0\x0dIHDR", None),
        (jpeg_of(size=b"\x08\0\0\0\x50\x03"), None),
        (b"GIF89a" + bytes(20), None),
        (b"", None),
    ],
)
def test_headers_state_sizes(data: bytes, size: tuple[int, int] | None) -> None:
    assert stated_size(data) == size


def box(width: int, height: int) -> bytes:
    return b"\0\0\0\x14ispe" + bytes(4) + struct.pack(">II", width, height)


def test_a_heif_s_size_is_the_largest_that_it_states() -> None:
    head = b"\0\0\0\x14ftypheic" + bytes(8)
    assert stated_size(head + box(512, 512) + box(6000, 3000) + box(160, 90)) == (3000, 6000)
    assert stated_size(head + box(10, 1000) + box(200, 100)) == (100, 200)
    assert stated_size(head) is None
    assert stated_size(head + box(6000, 3000)[:-1]) is None
    assert stated_size(head + bytes(1 << 20) + box(6000, 3000)) is None  # too far behind for a header


def test_of_a_file_no_more_is_read_than_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for padding in (0, 10, (1 << 16) - 100, 1 << 16, 1 << 20):
        data = webp_of(chunk(b"ICCP", bytes(padding)), LOSSY)
        path.write_bytes(data)
        assert stated_size_of_file(path) == (200, 300), padding
    path.write_bytes(b"nothing" * 20_000)
    assert stated_size_of_file(path) is None
    assert stated_size_of_file(tmp_path / "none") is None


def test_a_file_that_states_its_size_at_once_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(webp_of(LOSSY))
    os.truncate(path, 1 << 36)  # takes no room on the disk, and more than there is in memory
    assert stated_size_of_file(path) == (200, 300)


def tiff_of(*entries: tuple[int, int, int, bytes], order: str = "<", big: bool = False, tail: bytes = b"") -> bytes:
    """Return a TIFF of one directory; an entry is tag, type, count and the bytes of its value, or offset."""
    start = b"II" if order == "<" else b"MM"
    if big:
        head = start + struct.pack(order + "HHHQ", 43, 8, 0, 16) + struct.pack(order + "Q", len(entries))
        rows = [struct.pack(order + "HHQ", tag, kind, n) + value.ljust(8, b"\0") for tag, kind, n, value in entries]
    else:
        head = start + struct.pack(order + "HI", 42, 8) + struct.pack(order + "H", len(entries))
        rows = [struct.pack(order + "HHI", tag, kind, n) + value.ljust(4, b"\0") for tag, kind, n, value in entries]
    return head + b"".join(rows) + tail


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("kind", "code"), [(3, "H"), (4, "I"), (13, "I")])
def test_a_tiff_states_its_size_in_either_order_and_form(order: str, big: bool, kind: int, code: str) -> None:
    values = [struct.pack(order + code, number) for number in (300, 200)]
    data = tiff_of((256, kind, 1, values[0]), (257, kind, 1, values[1]), order=order, big=big, tail=bytes(4))
    assert stated_size(data) == (200, 300)
    assert stated_size(data[:16]) is None
    tiff = open_tiff(data)
    assert tiff is not None
    assert (tiff.order, tiff.is_big, tiff.first) == (order, big, 16 if big else 8)
    entries = tiff.directory(tiff.first)
    assert list(entries) == [256, 257]
    assert tiff.raw(entries[257]) == values[1]
    assert tiff.integer(entries[256]) == 300
    assert tiff.integer(entries.get(258)) is None


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_values_of_large_fields_stand_elsewhere(order: str) -> None:
    tail = struct.pack(order + "6I", 1, 2, 10, 4, 7, 1)
    at = 8 + 2 + 2 * 12
    data = tiff_of((1, 5, 3, struct.pack(order + "I", at)), (2, 2, 4, b"abcd"), order=order, tail=tail)
    tiff = open_tiff(data)
    assert tiff is not None
    entries = tiff.directory(8)
    assert entries == {1: Entry(5, at, at + 24), 2: Entry(2, at - 4, at)}
    assert tiff.raw(entries[2]) == b"abcd"
    assert tiff.rationals(entries[1], 3) == (0.5, 2.5, 7.0)
    assert tiff.rationals(entries[1], 2) == (0.5, 2.5)
    assert tiff.rationals(entries[1], 4) is None
    assert tiff.rationals(entries[2], 1) is None
    assert tiff.integer(entries[1]) is None
    without = open_tiff(data[:-4] + bytes(4))
    assert without is not None
    with pytest.raises(ZeroDivisionError, match="division by zero"):
        without.rationals(entries[1], 3)


def test_a_big_tiff_s_larger_values_stand_elsewhere_too() -> None:
    at = 16 + 8 + 20
    data = tiff_of((1, 16, 2, struct.pack("<Q", at)), big=True, tail=struct.pack("<QQ", 1 << 40, 5))
    tiff = open_tiff(data)
    assert tiff is not None
    entry = tiff.directory(16)[1]
    assert entry == Entry(16, at, at + 16)
    assert tiff.integer(entry) == 1 << 40


def test_fields_that_lie_outside_or_come_twice_are_left_out() -> None:
    data = tiff_of(
        (1, 4, 2, struct.pack("<I", 10_000)),
        (2, 3, 1, b"\x05\0"),
        (2, 3, 1, b"\x06\0"),
        (3, 3, 0, b""),
        (4, 99, 4, b"abcd"),
        tail=bytes(4),
    )
    tiff = open_tiff(data)
    assert tiff is not None
    entries = tiff.directory(8)
    assert list(entries) == [2, 3, 4]
    assert tiff.integer(entries[2]) == 5
    assert tiff.integer(entries[3]) is None
    assert tiff.raw(entries[4]) == b"abcd"  # of an unknown type, one byte each
    with pytest.raises(struct.error, match="unpack_from"):
        tiff.directory(len(data) - 1)


def test_a_directory_has_so_many_entries_at_most() -> None:
    tiff = open_tiff(tiff_of(*((number, 3, 1, b"\x01\0") for number in range(1200))))
    assert tiff is not None
    assert len(tiff.directory(8)) == 1000


@pytest.mark.parametrize(
    "data", [b"II*\0" + bytes(11), b"IM*\0" + bytes(20), b"II\x2c\0" + bytes(20), b"MM*\0" + bytes(20)]
)
def test_what_is_no_tiff_is_none(data: bytes) -> None:
    assert open_tiff(data) is None


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((100, 200), (100, 200), True),
        ((100, 200), (50, 100), True),
        ((100, 200), (33, 67), True),
        ((100, 200), (33, 66), True),
        ((100, 200), (33, 68), True),
        ((100, 200), (33, 69), False),
        ((100, 200), (34, 67), True),
        ((100, 200), (35, 67), False),
        ((100, 200), (200, 100), False),
        ((3, 7), (300, 697), True),
    ],
)
def test_sizes_of_one_picture_have_one_shape_but_for_rounding(
    one: tuple[int, int], other: tuple[int, int], same: bool
) -> None:
    assert same_shape(one, other) is same
    assert same_shape(other, one) is same


@pytest.mark.parametrize(
    ("crop", "rows", "columns"),
    [
        ((0, 0, 80, 40), (0, 10), (0, 20)),
        ((8, 4, 40, 20), (1, 6), (2, 12)),
        ((9, 5, 40, 20), (2, 6), (3, 12)),
        ((7, 3, 40, 20), (1, 5), (2, 11)),
        ((8, 4, 43, 23), (1, 6), (2, 12)),
    ],
)
def test_only_pixels_that_lie_whole_in_a_crop_are_inside(
    crop: tuple[int, int, int, int], rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    assert inside_crop((10, 20), crop, (40, 80)) == (slice(*rows), slice(*columns))


def test_reading_a_panorama_takes_what_its_files_take_at_their_own_size() -> None:
    picture = FilePart(Path("a.jpg"), external=True)
    plain = Panorama(picture, (100, 200), (1000, 2000))
    assert plain.loading_bytes() == 8 * 2_000_000
    assert Panorama(picture, (100, 200), (1000, 2000), (0, 0, 500, 400)).loading_bytes() == 8 * 200_000
    tiff = FilePart(Path("a.tif"), external=True)
    assert Panorama(tiff, (100, 200), (1000, 2000)).loading_bytes() == 18 * 2_000_000
    own, users = FilePart(Path("m.png")), FilePart(Path("m.png"), external=True)
    crop = (0, 0, 20, 10)
    assert Panorama(picture, (100, 200), (1000, 2000), crop, own).loading_bytes() == 8 * 100 * 200
    assert Panorama(picture, (10, 20), (1000, 2000), crop, users).loading_bytes() == 8 * 200


@pytest.mark.parametrize(("size", "fits"), [((4, 8), True), ((4, 9), False), ((0, 0), False), ((8, 4), False)])
def test_the_working_size_is_that_of_a_full_sphere(size: tuple[int, int], fits: bool) -> None:
    panorama = Panorama(FilePart(Path("a.jpg")), size, (100, 200))
    if fits:
        panorama.check()
    else:
        with pytest.raises(ContractError, match="is not that of a full sphere"):
            panorama.check()
    assert np.prod(panorama.covers_ltwh[2:]) == 20_000
