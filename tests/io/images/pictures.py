"""Picture files made for the tests: with and without GPano, in every container."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pano_mvs.io.images.metadata import GPano, find_gpano, read_container

GPANO = "http://ns.google.com/photos/1.0/panorama/"
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def xmp(fields: Mapping[str, object], *, form: str = "element", wrapped: bool = True) -> bytes:
    """An XMP packet with GPano fields as elements or as attributes."""
    if form == "element":
        inner = "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in fields.items())
        description = f'<rdf:Description rdf:about="" xmlns:GPano="{GPANO}">{inner}</rdf:Description>'
    else:
        inner = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
        description = f'<rdf:Description rdf:about="" xmlns:GPano="{GPANO}" {inner}/>'
    rdf = f'<rdf:RDF xmlns:rdf="{RDF}">{description}</rdf:RDF>'
    return (f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{rdf}</x:xmpmeta>' if wrapped else rdf).encode()


def full_sphere(height: int, width: int, **more: object) -> dict[str, object]:
    return {
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": height,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 0,
    } | more


def picture(size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    return np.random.default_rng(size_hw[0]).integers(0, 256, (*size_hw, 3)).astype(np.uint8)


def app1(payload: bytes) -> bytes:
    """A metadata segment of a JPEG."""
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def write_jpeg(
    path: Path,
    size_hw: tuple[int, int],
    packet: bytes | None = None,
    *,
    segments: bytes = b"",
    behind: bytes = b"",
    progressive: bool = False,
) -> Path:
    """A JPEG with an XMP packet, other segments in front of it, and bytes behind its end."""
    data = bytes(cv2.imencode(".jpg", picture(size_hw), [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)])[1])
    if packet is not None:
        segments += app1(b"http://ns.adobe.com/xap/1.0/\0" + packet)
    path.write_bytes(data[:2] + segments + data[2:] + behind)
    return path


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def write_png(
    path: Path,
    size_hw: tuple[int, int],
    packet: bytes | None = None,
    *,
    compressed: bool = False,
    exif_bytes: bytes | None = None,
    at: int = 33,
) -> Path:
    """A PNG with metadata behind its header, or elsewhere: -12 is in front of the last chunk."""
    data = bytes(cv2.imencode(".png", picture(size_hw))[1])
    chunks = b"" if exif_bytes is None else png_chunk(b"eXIf", exif_bytes)
    if packet is not None:
        text = zlib.compress(packet) if compressed else packet
        body = b"XML:com.adobe.xmp\0" + (b"\1\0" if compressed else b"\0\0") + b"\0\0" + text
        chunks += png_chunk(b"iTXt", body)
    path.write_bytes(data[:at] + chunks + data[at:])
    return path


def exif(
    order: str = "<",
    *,
    refs: tuple[bytes, bytes, int] = (b"N", b"E", 0),
    latitude: Sequence[tuple[int, int]] | None = None,
    longitude: Sequence[tuple[int, int]] | None = None,
    altitude: tuple[int, int] = (1234, 10),
    orientation: int | None = None,
) -> bytes:
    """EXIF metadata: a TIFF directory with the GPS directory, that with six entries, and perhaps an orientation."""
    latitude = latitude or ((47, 1), (30, 1), (3600, 100))
    longitude = longitude or ((8, 1), (15, 1), (0, 1))
    turned = b"" if orientation is None else struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0)
    at = 8 + 2 + len(turned) + 12 + 4  # behind the header and the first directory
    values = at + 2 + 6 * 12 + 4
    header = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "HI", 42, 8)
    first = struct.pack(order + "H", 1 + bool(turned)) + turned + struct.pack(order + "HHII", 0x8825, 4, 1, at)
    entries = [
        struct.pack(order + "HHI", 1, 2, 2) + refs[0].ljust(4, b"\0"),
        struct.pack(order + "HHII", 2, 5, 3, values),
        struct.pack(order + "HHI", 3, 2, 2) + refs[1].ljust(4, b"\0"),
        struct.pack(order + "HHII", 4, 5, 3, values + 24),
        struct.pack(order + "HHI", 5, 1, 1) + bytes([refs[2], 0, 0, 0]),
        struct.pack(order + "HHII", 6, 5, 1, values + 48),
    ]
    numbers = b"".join(struct.pack(order + "II", *pair) for pair in (*latitude, *longitude, altitude))
    return header + first + bytes(4) + struct.pack(order + "H", 6) + b"".join(entries) + bytes(4) + numbers


def by_pillow(size_hw: tuple[int, int], kind: str, *, mode: str = "RGB", **more: Any) -> bytes:
    """The bytes of a picture as another program writes them."""
    stream = io.BytesIO()
    Image.fromarray(picture(size_hw)).convert(mode).save(stream, kind, **more)
    return stream.getvalue()


def sound_files(size_hw: tuple[int, int], packet: bytes) -> list[bytes]:
    """The bytes of a small file in every container, each with the same metadata: XMP and EXIF."""
    jpeg = bytes(cv2.imencode(".jpg", picture(size_hw))[1])
    segments = app1(b"Exif\0\0" + exif()) + app1(b"http://ns.adobe.com/xap/1.0/\0" + packet)
    webp: dict[str, Any] = {"xmp": packet, "exif": exif(), "lossless": True}
    return [
        jpeg[:2] + segments + jpeg[2:],
        by_pillow(size_hw, "WEBP", **webp),
        by_pillow(size_hw, "TIFF", tiffinfo={700: packet}),
        by_pillow(size_hw, "TIFF", tiffinfo={700: packet}, big_tiff=True),
    ]


def gpano_of(path: Path) -> GPano | None:
    data = path.read_bytes()
    return find_gpano(read_container(data).xmp, data)[0]
