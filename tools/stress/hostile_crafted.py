"""Hostile files that no random change makes: headers that promise too much, bombs, numbers without end."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from tests.io.images.pictures import png_chunk

if TYPE_CHECKING:
    from tools.stress.hostile_samples import Sample

Crafted = tuple[str, str, dict[str, bytes]]
_NAN = float("nan")
_SIZES = ((30_000, 15_000), (40_000, 30_000), (1_048_577, 2), (2_000_000, 1_000_000), (2**31 - 1, 2**31 - 1), (0, 0))


def crafted(good: Mapping[str, Sample]) -> Iterator[Crafted]:
    """Yield inputs: a name, the kind whose sample they change, and the files that are other than the sample's."""
    yield from _pictures(good)
    yield from _arrays(good)
    yield from _models(good)
    yield from _poses()
    yield from _clouds(good)
    yield from _workflows()


def _pictures(good: Mapping[str, Sample]) -> Iterator[Crafted]:
    png, jpeg, tiff = (good[kind].files["picture.img"] for kind in ("png", "jpeg", "tiff"))
    for width, height in _SIZES:
        header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, 8, 2, 0, 0, 0))
        yield f"PNG of {width}×{height}", "png", {"picture.img": png[:8] + header + png[33:]}
        yield f"mask of {width}×{height}", "mask_png", {"mask.png": png[:8] + header + png[33:]}
        yield f"TIFF of {width}×{height}", "tiff", {"picture.img": _tiff_of(tiff, width, height)}
        yield (
            f"range TIFF of {width}×{height}",
            "range_tiff",
            {"range.tiff": _tiff_of(good["range_tiff"].files["range.tiff"], width, height)},
        )
    frame = jpeg.index(b"\xff\xc0")
    for width, height in ((65_535, 65_535), (0, 0), (65_500, 32_750)):
        data = jpeg[: frame + 5] + struct.pack(">HH", height, width) + jpeg[frame + 9 :]
        yield f"JPEG of {width}×{height}", "jpeg", {"picture.img": data}
    for share in (0.3, 0.7, 0.99):
        for kind in ("jpeg", "jpeg_progressive", "jpeg_restarts"):
            data = good[kind].files["picture.img"]
            yield (
                f"{kind}: {share:.0%} and the end marker",
                kind,
                {"picture.img": data[: int(len(data) * share)] + b"\xff\xd9"},
            )
    bomb = zlib.compress(bytes(64 << 20))
    for chunk, body in ((b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0"), (b"zTXt", b"Comment\0\0"), (b"iCCP", b"x\0\0")):
        chunks = png_chunk(chunk, body + bomb) * 30  # more than the memory that reading may take
        yield f"30 chunks {chunk.decode()} of 64 MB", "png", {"picture.img": png[:33] + chunks + png[33:]}
    packets = b"<x:xmpmeta <</x:xmpmeta>" * 20_000
    yield "20,000 malformed packets", "jpeg", {"picture.img": jpeg + packets}
    yield "a packet with entities", "jpeg", {"picture.img": jpeg + _entities()}
    nested = b"<x:xmpmeta>" + b"<a>" * 100_000 + b"</x:xmpmeta>"
    yield "a packet of 100,000 levels", "jpeg", {"picture.img": jpeg + nested}


def _tiff_of(data: bytes, width: int, height: int) -> bytes:
    """Return a TIFF whose directory states another size."""
    changed = bytearray(data)
    (first,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, first)
    for at in range(first + 2, first + 2 + 12 * count, 12):
        (tag,) = struct.unpack_from("<H", data, at)
        if tag in (256, 257, 278):
            value = width if tag == 256 else height
            struct.pack_into("<HII", changed, at + 2, 4, 1, value & 0xFFFFFFFF)
    return bytes(changed)


def _entities() -> bytes:
    lines = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
    return f'<x:xmpmeta><!DOCTYPE x [<!ENTITY a0 "a">{lines}]>&a11;</x:xmpmeta>'.encode()


def _arrays(good: Mapping[str, Sample]) -> Iterator[Crafted]:
    shapes = [
        "(1000000000000,)",
        "(2000000, 1000000)",
        "(-1, 5)",
        "(4611686018427387904, 4)",
        "(9,) * 9",
        "(1, 2, 3)",
        f"({'9' * 5000},)",
        "[64, 128]",
        "(64.5, 128)",
        "()",
    ]
    for shape in shapes:
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
        yield f"npy of shape {shape[:30]}", "range_npy", {"range.npy": _npy(header)}
        yield f"npz of shape {shape[:30]}", "range_npz", {"range.npz": _npz({"range.npy": _npy(header)})}
        yield f"truth of shape {shape[:30]}", "truth", {"depth.npz": _npz({"000.npy": _npy(header)})}
    for descr in (
        "'|O'",
        "'<U1000000000'",
        "[('a', '<f4', (100000, 100000))]",
        "'<M8[s]'",
        "'|V0'",
        "'c16'",
        "{}",
        "1",
    ):
        header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': (64, 128), }}"
        yield f"npy of {descr}", "range_npy", {"range.npy": _npy(header)}
    for header in ("{", "(" * 5000, "{'descr': '<f4'}", "[]", "\0", "{'shape': lambda: 0}"):
        yield f"npy with the header {header[:10]!r}", "range_npy", {"range.npy": _npy(header)}
    big = _npz(
        {"range.npy": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (20000, 40000), }") + bytes(60_000_000)}
    )
    yield "npz that inflates a thousandfold", "range_npz", {"range.npz": big}
    yield "npz with a name that is none", "range_npz", {"range.npz": _npz({"../../a.npy": b"", "\x1b[2J.npy": b""})}
    encrypted = bytearray(good["range_npz"].files["range.npz"])
    encrypted[6] |= 1
    encrypted[encrypted.index(b"PK\1\2") + 8] |= 1
    yield "encrypted npz", "range_npz", {"range.npz": bytes(encrypted)}
    if "range_exr" in good:
        data = good["range_exr"].files["range.exr"]
        window = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        for box in ((0, 0, 29_999, 14_999), (0, 0, 2**20, 2**20), (5, 5, 0, 0), (-(2**31), 0, 2**31 - 1, 0)):
            changed = data[:window] + struct.pack("<4i", *box) + data[window + 16 :]
            yield f"EXR with the window {box}", "range_exr", {"range.exr": changed}
    for text in (b"999999999&999999999&1&", b"0&0&0&", b"1&1&99&", b"9" * 5000 + b"&1&1&"):
        yield f"COLMAP map {text[:20]!r}", "colmap_map", {"map.bin": text}
    far = bytes(cv2.imencode(".tiff", np.full((64, 128), 1e300))[1])
    yield "ranges beyond float32", "range_tiff", {"range.tiff": far}


def _npy(header: str) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text


def _npz(members: Mapping[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


def _models(good: Mapping[str, Sample]) -> Iterator[Crafted]:
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        data = good["colmap_bin"].files[name]
        yield f"empty {name}", "colmap_bin", {name: b""}
        for count in (0, 10**6, 2**40, 2**63, 2**64 - 1):
            yield f"{count} entries in {name}", "colmap_bin", {name: struct.pack("<Q", count) + data[8:]}
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        for text in (
            "",
            "x",
            "1 " * 100,
            f"{'9' * 5000} 1 2 3",
            "nan " * 20,
            "\0",
            "1 EQUIRECTANGULAR 1024 512",
            "1 PINHOLE 1 1",
            "-1 -1 -1 -1 -1 -1 -1 -1 -1 a\n",
        ):
            yield f"{name} with {text[:20]!r}", "colmap_txt", {name: text.encode()}
    points, images = (good["colmap_bin"].files[name] for name in ("points3D.bin", "images.bin"))
    yield "a track without end", "colmap_bin", {"points3D.bin": points[:51] + struct.pack("<Q", 2**60) + points[59:]}
    yield "a name without end", "colmap_bin", {"images.bin": images[:72] + b"a" * 100_000}
    for place in (12, 44):
        nan = images[:place] + struct.pack("<d", _NAN) + images[place + 8 :]
        yield f"NaN at {place} of images.bin", "colmap_bin", {"images.bin": nan}
        yield f"NaN at {place} of a sphere's images.bin", "sphere_bin", {"images.bin": nan}


def _poses() -> Iterator[Crafted]:
    for value in ("NaN", "Infinity", "1e999", "9" * 5000, "null", '"1"', "[[[[]]]]", "[" * 3000 + "]" * 3000):
        rotation = f"[[{value}, 0, 0], [0, 1, 0], [0, 0, 1]]"
        view = f'{{"views": [{{"image": "a.png", "R": {rotation}, "t": [0, 0, 0]}}]}}'
        yield f"poses.json with {value[:20]}", "poses_json", {"poses.json": view.encode()}
        matrix = f"[[{value}, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
        frame = f'{{"camera_model": "EQUIRECTANGULAR", "frames": [{{"file_path": "a", "transform_matrix": {matrix}}}]}}'
        yield f"transforms.json with {value[:20]}", "transforms_json", {"transforms.json": frame.encode()}
        shot = f'{{"camera": "c", "rotation": [{value}, 0, 0], "translation": [0, 0, 0]}}'
        sfm = f'[{{"cameras": {{"c": {{"projection_type": "spherical"}}}}, "shots": {{"a": {shot}}}}}]'
        yield f"reconstruction.json with {value[:20]}", "reconstruction_json", {"reconstruction.json": sfm.encode()}
        row = f"name,tx,ty,tz,qw,qx,qy,qz\na,{value},0,0,1,0,0,0\n"
        yield f"poses.csv with {value[:20]}", "poses_csv", {"poses.csv": row.encode()}
    views: list[Any] = [None, 1, [], {}, {"views": 1}, {"views": [1]}, {"views": []}, {"views": [{"image": "\x1b[2J"}]}]
    others: list[Any] = [{"frames": [None]}, [{"shots": 1}], [{"shots": {}, "cameras": {}}]]
    for document in [*views, *others]:
        text = json.dumps(document)
        yield f"poses.json with {text}", "poses_json", {"poses.json": text.encode()}
    yield "poses.json in UTF-16", "poses_json", {"poses.json": '{"views": []}'.encode("utf-16")}
    yield "a cell of 1 MB", "poses_csv", {"poses.csv": b"name,tx,ty,tz,qw,qx,qy,qz\n" + b"a" * 1_000_000}
    for huge in ("1e308", "-1e200", "1e-320"):
        row = f"name,tx,ty,tz,qw,qx,qy,qz\na,0,0,0,{huge},{huge},0,0\n"
        yield f"a quaternion of {huge}", "poses_csv", {"poses.csv": row.encode()}


def _clouds(good: Mapping[str, Sample]) -> Iterator[Crafted]:
    for kind in ("ply", "ply_text", "ply_mesh"):
        data = good[kind].files["cloud.ply"]
        for count in (b"9" * 5000, b"99999999999999", b"-1", b"", b"0", b"1e9", b"\xd9\xa3"):
            changed = data.replace(b"element vertex 50", b"element vertex " + count, 1)
            yield f"{kind} of {count[:20]!r} points", kind, {"cloud.ply": changed}
        yield f"{kind} with a property twice", kind, {"cloud.ply": data.replace(b"float y", b"float x", 1)}
        yield f"{kind} without an end", kind, {"cloud.ply": data.replace(b"end_header", b"end_heade", 1)}
    faces = good["ply_mesh"].files["cloud.ply"].replace(b"element face 20", b"element face " + b"9" * 5000, 1)
    yield "5,000 digits of faces", "ply_mesh", {"cloud.ply": faces}


def _workflows() -> Iterator[Crafted]:
    bomb = "a: &a0 [x]\n" + "".join(f"b{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12))
    texts = (
        bomb,
        "pano_mvs: " + "9" * 5000,
        "[" * 5000,
        "? " * 3000,
        "pano_mvs: 1\nstages: &a {x: *a}",
        "\0",
        "pano_mvs: 1\nextends: workflow.yaml\n",
        "!!python/object/apply:os.system [id]",
        "\ufeff",
        "- " * 9999,
        "pano_mvs: 1\nstages: {a\x1b[2J: {use: x}}",
        "pano_mvs: 1\nplugins: [/dev/zero]\nstages: {}",
    )
    for text in texts:
        yield f"workflow {text[:30]!r}", "workflow", {"workflow.yaml": text.encode()}
