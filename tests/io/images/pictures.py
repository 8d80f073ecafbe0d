"""Picture files made for the tests: with and without GPano, in every container."""

import io
import struct
import zlib

import cv2
import numpy as np
from PIL import Image

GPANO = "http://ns.google.com/photos/1.0/panorama/"
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def xmp(fields, *, form="element", wrapped=True):
    """An XMP packet with GPano fields as elements or as attributes."""
    if form == "element":
        inner = "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in fields.items())
        description = f'<rdf:Description rdf:about="" xmlns:GPano="{GPANO}">{inner}</rdf:Description>'
    else:
        inner = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
        description = f'<rdf:Description rdf:about="" xmlns:GPano="{GPANO}" {inner}/>'
    rdf = f'<rdf:RDF xmlns:rdf="{RDF}">{description}</rdf:RDF>'
    return (f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{rdf}</x:xmpmeta>' if wrapped else rdf).encode()


def full_sphere(height, width, **more):
    return {
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": height,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 0,
    } | more


def picture(size_hw):
    return np.random.default_rng(size_hw[0]).integers(0, 256, (*size_hw, 3)).astype(np.uint8)


def app1(payload):
    """A metadata segment of a JPEG."""
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def write_jpeg(path, size_hw, packet=None, *, segments=b"", behind=b"", progressive=False):
    """A JPEG with an XMP packet, other segments in front of it, and bytes behind its end."""
    data = bytes(cv2.imencode(".jpg", picture(size_hw), [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)])[1])
    if packet is not None:
        segments += app1(b"http://ns.adobe.com/xap/1.0/\0" + packet)
    path.write_bytes(data[:2] + segments + data[2:] + behind)
    return path


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def write_png(path, size_hw, packet=None, *, compressed=False, exif_bytes=None, at=33):
    """A PNG with metadata behind its header, or elsewhere: -12 is in front of the last chunk."""
    data = bytes(cv2.imencode(".png", picture(size_hw))[1])
    chunks = b"" if exif_bytes is None else png_chunk(b"eXIf", exif_bytes)
    if packet is not None:
        text = zlib.compress(packet) if compressed else packet
        body = b"XML:com.adobe.xmp\0" + (b"\1\0" if compressed else b"\0\0") + b"\0\0" + text
        chunks += png_chunk(b"iTXt", body)
    path.write_bytes(data[:at] + chunks + data[at:])
    return path


def exif(order="<", *, refs=(b"N", b"E", 0), latitude=None, longitude=None, altitude=(1234, 10), orientation=None):
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


def by_pillow(size_hw, kind, *, mode="RGB", **more):
    """The bytes of a picture as another program writes them."""
    stream = io.BytesIO()
    Image.fromarray(picture(size_hw)).convert(mode).save(stream, kind, **more)
    return stream.getvalue()


def sound_files(size_hw, packet):
    """The bytes of a small file in every container, each with the same metadata: XMP and EXIF."""
    jpeg = bytes(cv2.imencode(".jpg", picture(size_hw))[1])
    segments = app1(b"Exif\0\0" + exif()) + app1(b"http://ns.adobe.com/xap/1.0/\0" + packet)
    webp = {"xmp": packet, "exif": exif(), "lossless": True}
    return [
        jpeg[:2] + segments + jpeg[2:],
        by_pillow(size_hw, "WEBP", **webp),
        by_pillow(size_hw, "TIFF", tiffinfo={700: packet}),
        by_pillow(size_hw, "TIFF", tiffinfo={700: packet}, big_tiff=True),
    ]
