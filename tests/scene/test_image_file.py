"""Pictures as cameras and programs write them, against what Pillow reads of them."""

from __future__ import annotations

import io
import struct
import sys
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

from pano_mvs.core.errors import InputError
from pano_mvs.scene.exr import write_exr
from pano_mvs.scene.image_file import decode_image, decode_opacity
from pano_mvs.scene.image_header import (
    PNG_START,
    has_alpha,
    has_unread_alpha,
    holds_floats,
    is_map,
    of_file,
    stated_size,
)
from tests.io.images.pictures import app1, by_pillow, exif

SIZE = (32, 64)
SMOOTH = cv2.resize(np.random.default_rng(1).integers(0, 256, (4, 8, 3)).astype(np.uint8), SIZE[::-1])


def saved(kind: str, mode: str = "RGB", **more: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(SMOOTH).convert(mode).save(stream, kind, **more)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("kind", "mode", "more"),
    [
        ("JPEG", "RGB", {"progressive": True}),
        ("JPEG", "L", {}),
        ("JPEG", "CMYK", {"quality": 95}),
        ("PNG", "RGB", {}),
        ("PNG", "RGBA", {}),
        ("PNG", "LA", {}),
        ("PNG", "L", {}),
        ("PNG", "P", {}),
        ("PNG", "1", {}),
        ("TIFF", "RGB", {"compression": "tiff_lzw"}),
        ("TIFF", "RGB", {"compression": "jpeg"}),
        ("TIFF", "RGB", {"big_tiff": True}),
        ("TIFF", "RGBA", {}),
        ("TIFF", "L", {}),
        ("WEBP", "RGB", {"quality": 95}),
        ("WEBP", "RGBA", {"lossless": True}),
        ("AVIF", "RGB", {"quality": 90}),
    ],
)
def test_what_pillow_writes_is_read_as_pillow_reads_it(
    tmp_path: Path, kind: str, mode: str, more: dict[str, object]
) -> None:
    path = tmp_path / "picture of 1° – ünïcode.X"
    path.write_bytes(saved(kind, mode, **more))
    expected = np.asarray(Image.open(path).convert("RGB")).astype(int)
    tolerance = 0 if kind == "PNG" or more.get("lossless") else 12  # decoders of lossy pictures round on their own
    np.testing.assert_allclose(decode_image(path), expected, atol=tolerance)


@pytest.mark.parametrize("factor", [257, 256])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_eight_bits_written_as_sixteen_come_back(tmp_path: Path, factor: int, suffix: str) -> None:
    """255 is 65535 to programs that repeat the byte, and 65280 to those that shift it; either way none is lost."""
    levels = np.arange(256, dtype=np.uint16).repeat(3).reshape(8, 32, 3)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(bytes(cv2.imencode(suffix, levels * np.uint16(factor))[1]))
    np.testing.assert_array_equal(decode_image(path), levels)


def hdr_files(linear: np.ndarray, folder: Path) -> list[Path]:
    """Write linear colours, (H, W, 3) RGB, in each format of floats."""
    paths = [folder / name for name in ("a.hdr", "a.tif", "a.exr")]
    for path in paths[:2]:
        path.write_bytes(bytes(cv2.imencode(path.suffix, np.ascontiguousarray(linear[..., ::-1]))[1]))
    write_exr(paths[2], {name: np.ascontiguousarray(linear[..., idx]) for idx, name in enumerate("RGB")})
    return paths


@pytest.mark.parametrize("brightness", [1e-4, 1.0, 1e6])
def test_hdr_pictures_are_tone_mapped_whatever_their_brightness(tmp_path: Path, brightness: float) -> None:
    """They were skipped without a word, and floating-point TIFF files were refused."""
    levels = brightness * np.linspace(0.05, 4.0, SIZE[1])
    linear = np.broadcast_to(np.outer(levels, [1.2, 1.0, 0.8]), (*SIZE, 3)).astype(np.float32)
    for path in hdr_files(linear, tmp_path):
        decoded = decode_image(path)
        assert decoded.dtype == np.uint8
        assert decoded.shape == (*SIZE, 3)
        assert decoded[0, 0, 0] > decoded[0, 0, 1] > decoded[0, 0, 2] > 10, "red is first"
        assert (np.diff(decoded[0].astype(int), axis=0) >= 0).all()
        assert 130 < decoded[0, -1, 1] < 255, "the brightest does not clip"
        assert has_alpha(path.read_bytes()) is is_map(path.read_bytes()) is False
        assert holds_floats(path.read_bytes())
        assert stated_size(path.read_bytes()) == SIZE


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_tiffs_of_floats_may_have_transparent_pixels(tmp_path: Path, dtype: type[np.floating]) -> None:
    """OpenCV decodes four channels of floats only unchanged, so they were refused."""
    linear = np.random.default_rng(3).uniform(0.1, 2.0, (*SIZE, 4)).astype(dtype)
    linear[:5, :, 3] = 0
    path, without = tmp_path / "a.tif", tmp_path / "b.tif"
    path.write_bytes(bytes(cv2.imencode(".tif", linear)[1]))
    without.write_bytes(bytes(cv2.imencode(".tif", np.ascontiguousarray(linear[..., :3]))[1]))
    np.testing.assert_array_equal(decode_image(path), decode_image(without))
    opaque = decode_opacity(path, path.read_bytes())
    assert opaque is not None
    assert np.flatnonzero(~opaque.all(axis=1)).tolist() == [0, 1, 2, 3, 4]


def test_values_that_no_colour_has_do_not_spoil_an_hdr_picture(tmp_path: Path) -> None:
    linear = np.full((*SIZE, 3), 0.5, np.float32)
    linear[0, :4] = np.array([np.nan, np.inf, -np.inf, -1])[:, None]
    for path in hdr_files(linear, tmp_path)[1:]:  # Radiance files cannot hold them
        decoded = decode_image(path)
        assert decoded[0, :4, 0].tolist() == [0, 255, 0, 0]
        assert np.ptp(decoded[1:]) == 0
        assert 100 < decoded[1, 0, 0] < 130, "middle grey"
    (black,) = {decode_image(path).max() for path in hdr_files(0 * linear[1:], tmp_path)}
    assert black == 0


def test_floats_without_colours_are_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "b.tif").write_bytes(by_pillow(SIZE, "TIFF", mode="F"))
    with pytest.raises(InputError, match=r"b\.tif: .*convert it to JPEG, or to PNG or TIFF of 8 or 16 bits"):
        decode_image(tmp_path / "b.tif")
    write_exr(tmp_path / "c.exr", {"Z": np.ones(SIZE, np.float32)})
    with pytest.raises(InputError, match=r"c\.exr: has no channels R, G and B, but Z\. Export its colours"):
        decode_image(tmp_path / "c.exr")
    assert is_map((tmp_path / "b.tif").read_bytes())
    assert of_file(tmp_path / "c.exr", is_map)


def test_exr_files_that_cannot_be_read_say_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = hdr_files(np.ones((*SIZE, 3), np.float32), tmp_path)[2]
    data = path.read_bytes()
    at = data.index(b"displayWindow\0box2i\0") + 24
    path.write_bytes(data[:at] + struct.pack("<4i", 0, 0, 99, 49) + data[at + 16 :])
    with pytest.raises(InputError, match=r"a\.exr: stores only the part \(0, 0, 63, 31\) of its picture .*Export all"):
        decode_image(path)
    for damaged in (data[: len(data) // 2], data[:60]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.exr: not a readable EXR file"):
            decode_image(path)
        assert stated_size(data[:60]) is None
        assert not is_map(data[:60])
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"a\.exr: .*pip install 'pano-mvs\[exr\]', or convert it to JPEG"):
        decode_image(path)


def with_alpha(mode: str = "RGBA", kind: str = "PNG", *, alpha: int = 0, **more: object) -> bytes:
    """A picture whose first five rows have an alpha, and whose sixth is hardly opaque."""
    pixels = np.dstack([SMOOTH, np.full(SIZE, 255, np.uint8)])
    pixels[:5, :, 3], pixels[5, :, 3] = alpha, max(alpha, 1)
    stream = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(stream, kind, **more)
    return stream.getvalue()


SIXTEEN = np.dstack([SMOOTH, np.full(SIZE, 255, np.uint8)]).astype(np.uint16) * np.uint16(257)
SIXTEEN[:5, :, 3] = 0


@pytest.mark.parametrize(
    "data",
    [
        with_alpha(),
        with_alpha("LA"),
        with_alpha(kind="WEBP"),
        with_alpha(kind="WEBP", lossless=True),
        with_alpha(kind="TIFF"),
        with_alpha(kind="TIFF", compression="tiff_lzw"),
        bytes(cv2.imencode(".png", SIXTEEN)[1]),
        bytes(cv2.imencode(".tif", SIXTEEN)[1]),
    ],
)
def test_transparent_pixels_are_known_in_every_container(data: bytes) -> None:
    opaque = decode_opacity(Path("a"), data)
    assert opaque is not None
    assert np.flatnonzero(~opaque.any(axis=1)).tolist() == [0, 1, 2, 3, 4]
    assert opaque[5:].all()


def test_a_colour_of_a_palette_may_be_transparent() -> None:
    stream = io.BytesIO()
    Image.fromarray(np.arange(256, dtype=np.uint8).reshape(8, 32)).convert("P").save(stream, "PNG", transparency=3)
    opaque = decode_opacity(Path("a"), stream.getvalue())
    assert opaque is not None
    assert np.argwhere(~opaque).tolist() == [[0, 3]]


def grey_png(bits: int, transparent: int) -> bytes:
    """The levels 0 to 3 of a grey PNG in its first row, then zeros."""
    levels = np.zeros(SIZE, np.uint16)
    levels[0, :4] = np.arange(4) % (1 << bits)
    if bits == 16:
        rows = levels.astype(">u2").view(np.uint8)
    else:
        ones = (levels[..., None] >> np.arange(bits)[::-1]) & 1
        rows = np.packbits(ones.reshape(SIZE[0], -1).astype(np.uint8), axis=1)
    header = struct.pack(">IIBBBBB", *SIZE[::-1], bits, 0, 0, 0, 0)
    pixels = zlib.compress(np.pad(rows, [(0, 0), (1, 0)]).tobytes())
    chunks = [(b"IHDR", header), (b"tRNS", struct.pack(">H", transparent)), (b"IDAT", pixels), (b"IEND", b"")]
    return PNG_START + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_a_level_of_grey_may_be_transparent(bits: int) -> None:
    """OpenCV drops it, so it was lost."""
    opaque = decode_opacity(Path("a"), grey_png(bits, 1))
    assert opaque is not None
    assert np.argwhere(~opaque).tolist() == ([[0, 1], [0, 3]] if bits == 1 else [[0, 1]])
    if bits >= 4:
        assert decode_opacity(Path("a"), grey_png(bits, 5)) is None


def test_the_alpha_of_a_grey_tiff_is_known_to_be_lost() -> None:
    for data in (with_alpha("LA", "TIFF"), with_alpha("LA", "TIFF", compression="tiff_lzw")):
        assert has_unread_alpha(data)
        assert decode_opacity(Path("a"), data) is None
    assert not any(map(has_unread_alpha, (with_alpha("LA"), with_alpha(kind="TIFF"), saved("TIFF", "L"))))


@pytest.mark.parametrize(
    "data",
    [
        *(saved(kind) for kind in ("JPEG", "PNG", "WEBP", "TIFF")),
        saved("TIFF", "CMYK"),
        *(with_alpha(kind=kind, alpha=255, lossless=True) for kind in ("PNG", "WEBP", "TIFF")),
        with_alpha()[:20],
        b"RIFF    WEBP",
    ],
)
def test_pictures_without_transparent_pixels_have_no_mask(data: bytes) -> None:
    assert decode_opacity(Path("a"), data) is None


def test_orientation_does_not_turn_the_pixels(tmp_path: Path) -> None:
    data = saved("JPEG")
    for orientation in (1, 3, 6):
        segment = app1(b"Exif\0\0" + exif(orientation=orientation))
        (tmp_path / f"{orientation}.jpg").write_bytes(data[:2] + segment + data[2:])
    for orientation in (3, 6):
        np.testing.assert_array_equal(decode_image(tmp_path / f"{orientation}.jpg"), decode_image(tmp_path / "1.jpg"))


def test_what_cameras_append_to_a_jpeg_is_not_taken_for_its_end(tmp_path: Path) -> None:
    """A video of some hundred kB behind the end marker made a sound picture count as truncated once."""
    data = saved("JPEG")
    (tmp_path / "sound.jpg").write_bytes(data + bytes(200_000))
    assert decode_image(tmp_path / "sound.jpg").shape == (*SIZE, 3)
    thumbnail = app1(b"Exif\0\0" + data)  # has an end marker of its own
    (tmp_path / "short.jpg").write_bytes((data[:2] + thumbnail + data[2:])[:-40])
    with pytest.raises(InputError, match="the JPEG ends early"):
        decode_image(tmp_path / "short.jpg")


def test_avif_that_opencv_does_not_read_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.avif").write_bytes(saved("AVIF")[:200])
    with pytest.raises(InputError, match=r"a\.avif: this OpenCV .* cannot read AVIF images, or the file is damaged"):
        decode_image(tmp_path / "a.avif")


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "WEBP", "HEIC"])
def test_what_is_cut_short_is_refused(tmp_path: Path, kind: str) -> None:
    data = heic(SMOOTH) if kind == "HEIC" else saved(kind)
    (tmp_path / "a.X").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"a\.X: not an? .*image that can be decoded"):
        decode_image(tmp_path / "a.X")


def heic(picture: np.ndarray) -> bytes:
    stream = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(picture)).save(stream, quality=95)
    return stream.getvalue()


@pytest.mark.parametrize("shape", ["RGB", "L", "RGBA"])
def test_heic_is_read(tmp_path: Path, shape: str) -> None:
    picture = np.asarray(Image.fromarray(SMOOTH).convert(shape))
    (tmp_path / "a.heic").write_bytes(heic(picture))
    decoded = decode_image(tmp_path / "a.heic")
    assert decoded.shape == (*SIZE, 3)
    np.testing.assert_allclose(decoded, np.asarray(Image.fromarray(picture).convert("RGB")).astype(int), atol=40)


def test_heic_without_its_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.heic").write_bytes(heic(SMOOTH))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"a\.heic: .*pip install 'pano-mvs\[heic\]', or convert it to JPEG"):
        decode_image(tmp_path / "a.heic")


BUDGETS = [pytest.param(".jpg", 8192, 110e6, marks=pytest.mark.slow), (".png", 2048, 10e6), (".tif", 2048, 26e6)]


@pytest.mark.parametrize(("suffix", "width", "budget"), BUDGETS)
def test_large_pictures_are_read_within_their_budget(tmp_path: Path, suffix: str, width: int, budget: float) -> None:
    """In numpy: one picture of 3 bytes a pixel, of a TIFF of 16 bits 6 and 3; the file only while it is decoded."""
    ramp = np.add.outer(np.arange(width // 2), np.arange(width)).astype(np.uint8)
    picture = np.dstack([ramp] * 3).astype(np.uint8 if suffix == ".jpg" else np.uint16)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(bytes(cv2.imencode(suffix, picture)[1]))
    tracemalloc.start()
    decoded = decode_image(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert decoded.shape == (width // 2, width, 3)
    assert decoded.flags.c_contiguous
    assert budget / 2 < peak < budget
