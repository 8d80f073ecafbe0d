"""Picture files made for the tests: with and without GPano, in every container."""

import struct
import zlib

import cv2
import numpy as np

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


def write_jpeg(path, size_hw, packet=None):
    data = bytes(cv2.imencode(".jpg", picture(size_hw))[1])
    if packet is not None:
        payload = b"http://ns.adobe.com/xap/1.0/\0" + packet
        data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]
    path.write_bytes(data)
    return path


def write_png(path, size_hw, packet=None, *, compressed=False):
    data = bytes(cv2.imencode(".png", picture(size_hw))[1])
    if packet is not None:
        text = zlib.compress(packet) if compressed else packet
        body = b"XML:com.adobe.xmp\0" + (b"\1\0" if compressed else b"\0\0") + b"\0\0" + text
        chunk = struct.pack(">I", len(body)) + b"iTXt" + body + struct.pack(">I", zlib.crc32(b"iTXt" + body))
        data = data[:33] + chunk + data[33:]  # behind the signature and IHDR
    path.write_bytes(data)
    return path
