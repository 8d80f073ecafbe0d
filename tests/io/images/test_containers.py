"""Metadata wherever a container may have them: in segments, chunks and tags, in pieces, behind the pixels."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

from pano_mvs.io.images.captures import describe_picture
from pano_mvs.io.images.metadata import GPano, read_container
from tests.io.images.pictures import (
    app1,
    by_pillow,
    exif,
    full_sphere,
    gpano_of,
    picture,
    png_chunk,
    sound_files,
    write_jpeg,
    write_png,
    xmp,
)

SIZE = (32, 64)
PACKET = xmp(full_sphere(*SIZE, PosePitchDegrees="1.5", PoseRollDegrees="-2"), form="attribute")
EXPECTED = GPano("equirectangular", SIZE, (0, 0, 64, 32), None, 1.5, -2.0)
POSITION: Any = pytest.approx((47.51, 8.25, 123.4))
FILLER = app1(b"filler\0" + bytes(65_000)) * 80  # 5 MB


def heif(kind: str) -> bytes:
    stream = io.BytesIO()
    image = Image.fromarray(picture(SIZE))
    if kind == "AVIF":
        image.save(stream, "AVIF", xmp=PACKET, exif=b"Exif\0\0" + exif())
    else:
        pillow_heif.from_pillow(image).save(stream, xmp=PACKET, exif=b"Exif\0\0" + exif(), quality=90)
    return stream.getvalue()


@pytest.mark.parametrize("idx", range(4), ids=["jpeg", "webp", "tiff", "bigtiff"])
def test_every_container_keeps_both_kinds(tmp_path: Path, idx: int) -> None:
    data = sound_files(SIZE, PACKET)[idx]
    (tmp_path / "a").write_bytes(data)
    assert read_container(data).size_hw == SIZE
    assert len(read_container(data).xmp) == 1
    assert gpano_of(tmp_path / "a") == EXPECTED
    if idx < 2:  # Pillow writes no GPS directory into a TIFF's own
        assert describe_picture(tmp_path / "a").position_lla == POSITION


@pytest.mark.parametrize("kind", ["HEIC", "AVIF"])
def test_heic_and_avif_have_both_kinds_too(tmp_path: Path, kind: str) -> None:
    (tmp_path / "A.HEIC").write_bytes(heif(kind))
    info = describe_picture(tmp_path / "A.HEIC")
    assert (info.size_hw, info.gpano, info.traits) == (SIZE, EXPECTED, ())
    assert info.position_lla == POSITION


@pytest.mark.parametrize("at", [33, -12])
def test_a_png_may_have_them_behind_its_pixels(tmp_path: Path, at: int) -> None:
    path = write_png(tmp_path / "a.png", SIZE, PACKET, compressed=True, exif_bytes=exif(">"), at=at)
    info = describe_picture(path)
    assert (info.gpano, info.position_lla) == (EXPECTED, POSITION)


def test_a_jpeg_may_have_them_behind_megabytes_of_other_segments(tmp_path: Path) -> None:
    """Only the first 4 MiB were searched once."""
    data = write_jpeg(tmp_path / "a.jpg", SIZE, PACKET).read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[:2] + FILLER + app1(b"Exif\0\0" + exif()) + data[2:])
    info = describe_picture(tmp_path / "a.jpg")
    assert (info.size_hw, info.gpano, info.position_lla) == (SIZE, EXPECTED, POSITION)


def test_an_extended_packet_is_joined_from_its_pieces(tmp_path: Path) -> None:
    """Adobe's XMP specification, part 3, section 1.1.3.1: pieces in any order, each with its offset."""
    long = PACKET.replace(b"<rdf:Description", b"<!--" + b"x" * 150_000 + b"--><rdf:Description")
    offsets = [130_000, 0, 65_000]
    pieces = [b"G" * 32 + struct.pack(">II", len(long), at) + long[at : at + 65_000] for at in offsets]
    extended = b"".join(app1(b"http://ns.adobe.com/xmp/extension/\0" + piece) for piece in pieces)
    main = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><other/></x:xmpmeta>'
    path = write_jpeg(tmp_path / "a.jpg", SIZE, main, segments=extended)
    assert gpano_of(path) == EXPECTED


def test_packets_behind_the_end_of_a_jpeg_are_found(tmp_path: Path) -> None:
    path = write_jpeg(tmp_path / "a.jpg", SIZE, behind=bytes(100_000) + PACKET)
    assert gpano_of(path) == EXPECTED


@pytest.mark.parametrize("form", ["jpeg", "png", "tiff"])
def test_an_orientation_is_ignored_and_told(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"a.{form}"
    turned = exif(orientation=6)
    if form == "jpeg":
        write_jpeg(path, SIZE, segments=app1(b"Exif\0\0" + turned))
    elif form == "png":
        write_png(path, SIZE, exif_bytes=turned)
    else:
        path.write_bytes(by_pillow(SIZE, "TIFF", tiffinfo={0x0112: 6}))
    info = describe_picture(path)
    assert info.size_hw == SIZE
    assert "EXIF orientation" in info.traits[0]


def test_a_tiff_whose_directory_stands_behind_its_pixels(tmp_path: Path) -> None:
    """As OpenCV writes them."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 128, 3), dtype=np.uint16)
    data = bytes(cv2.imencode(".tif", noise)[1])
    assert read_container(data).size_hw == (64, 128)
    assert read_container(data[:-200]).size_hw is None


def test_chunks_of_odd_length_are_padded_in_a_webp(tmp_path: Path) -> None:
    (tmp_path / "a.webp").write_bytes(by_pillow(SIZE, "WEBP", exif=exif() + b"\0", xmp=PACKET, lossless=True))
    assert len(read_container((tmp_path / "a.webp").read_bytes()).xmp) == 1
    assert describe_picture(tmp_path / "a.webp").gpano == EXPECTED


def test_compressed_packets_have_one_limit_for_the_whole_file(tmp_path: Path) -> None:
    """150 chunks of 64 MB each were all decompressed and kept once."""
    bomb = b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(bytes(12 << 20))
    path = write_png(tmp_path / "a.png", SIZE, PACKET)
    data = path.read_bytes()
    path.write_bytes(data[:-12] + png_chunk(b"iTXt", bomb) * 20 + data[-12:])
    tracemalloc.start()
    container = read_container(path.read_bytes())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6
    assert "larger than 16 MiB" in container.warning
    info = describe_picture(path)
    assert info.gpano == EXPECTED
    assert info.warnings == (container.warning,)
