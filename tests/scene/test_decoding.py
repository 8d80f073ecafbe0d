"""Limits of decoding: what headers state, what memory takes, and what the decoder says of damaged data."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.scene import image_file
from pano_mvs.scene.image_file import check_stated_size, decode_image, decode_picture
from pano_mvs.scene.masking import decode_mask
from tests.io.images.pictures import png_chunk

NOISE = np.random.default_rng(0).integers(0, 256, (64, 128, 3)).astype(np.uint8)
PICTURE = cv2.resize(NOISE, (256, 128), interpolation=cv2.INTER_CUBIC)


def encoded(suffix: str, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, PICTURE, list(options))[1])


def png_of(width: int, height: int, *, more: bytes = b"") -> bytes:
    data = bytes(cv2.imencode(".png", PICTURE[:4, :8])[1])
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return data[:8] + header + data[33:] + more


def test_pictures_beyond_the_limit_are_refused_by_name_with_the_figure(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encoded(".png"))
    with pytest.raises(InputError, match=r"a\.png: its header states 256×128 px .*more than the limit.*max_megapixels"):
        decode_image(tmp_path / "a.png", max_pixels=256 * 128 - 1)
    assert decode_image(tmp_path / "a.png", max_pixels=256 * 128).shape == (128, 256, 3)


@pytest.mark.parametrize("reader", [decode_image, decode_mask])
def test_a_header_is_believed_as_far_as_the_file_can_hold_it(tmp_path: Path, reader: object) -> None:
    assert callable(reader)
    (tmp_path / "a.png").write_bytes(png_of(20_000, 10_000))
    with pytest.raises(InputError, match=r"a\.png: its header states 20000×10000 px .* bytes cannot hold them"):
        reader(tmp_path / "a.png")


def test_opencvs_own_limit_is_reported_in_our_words(tmp_path: Path) -> None:
    """It showed as "(-215:Assertion failed) pixels <= CV_IO_MAX_IMAGE_PIXELS"."""
    data = png_of(40_000, 30_000, more=bytes(130_000))
    with pytest.raises(InputError, match=r"a\.png: .*40000×30000 px \(1200 megapixels\) is larger than OpenCV decodes"):
        decode_picture(data, tmp_path / "a.png", cv2.IMREAD_COLOR, max_pixels=1 << 40)


def refuse(*_: object) -> None:
    """Fail as OpenCV does where an assertion of its own does not hold."""
    error = cv2.error("no")
    error.code = -215
    raise error


@pytest.mark.parametrize(
    ("width", "height", "is_limit"),
    [
        ((1 << 20) + 1, 1, True),
        (1, (1 << 20) + 1, True),
        (1 << 20, 1, False),
        (1 << 15, 1 << 15, False),
        (1 << 15, (1 << 15) + 1, True),
    ],
)
def test_what_opencv_does_not_take_is_reported_with_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int, height: int, is_limit: bool
) -> None:
    monkeypatch.setattr(cv2, "imdecode", refuse)
    data = png_of(width, height, more=bytes(width * height // 10_000))
    said = r"is larger than OpenCV decodes, 1074 megapixels and 1048576 px" if is_limit else r"not an image that can be"
    with pytest.raises(InputError, match=said):
        decode_picture(data, tmp_path / "a.png", cv2.IMREAD_COLOR, max_pixels=1 << 40)


def test_a_small_picture_that_opencv_refuses_is_none_that_can_be_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", refuse)
    with pytest.raises(InputError, match=r"a\.png: not an image that can be decoded \(its header states 256×128 px\)"):
        decode_picture(encoded(".png"), tmp_path / "a.png", cv2.IMREAD_COLOR)
    with pytest.raises(InputError, match=r"a: not an image that can be decoded\. Copy it again"):
        decode_picture(b"something else", tmp_path / "a", cv2.IMREAD_COLOR)


@pytest.mark.parametrize(
    ("pixels", "size", "believed"),
    [
        (64_000_000, 33, True),
        (64_010_000, 33, False),
        (70_000_000, 7000, True),
        (70_010_000, 7000, False),
    ],
)
def test_a_header_is_believed_up_to_64_megapixels_or_10000_pixels_for_a_byte(
    tmp_path: Path, pixels: int, size: int, believed: bool
) -> None:
    data = png_of(10_000, pixels // 10_000)[:33].ljust(size, b"\0")
    if believed:
        assert check_stated_size(data, tmp_path / "a.png") == (pixels // 10_000, 10_000)
    else:
        with pytest.raises(InputError, match="cannot hold them"):
            check_stated_size(data, tmp_path / "a.png")


@pytest.mark.parametrize("share", [0.3, 0.9, 0.995])
@pytest.mark.parametrize(
    "options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 4)], ids=str
)
def test_a_jpeg_whose_data_end_before_its_end_marker_is_refused(
    tmp_path: Path, options: tuple[int, ...], share: float
) -> None:
    """libjpeg fills in grey, and says so on the error stream alone."""
    data = encoded(".jpg", *options)
    (tmp_path / "a.jpg").write_bytes(data[: int(share * len(data))] + b"\xff\xd9")
    with pytest.raises(InputError, match=r"a\.jpg: the JPEG is damaged or its data end early.*Copy it again"):
        decode_image(tmp_path / "a.jpg")


def test_padding_in_front_of_the_end_marker_does_no_harm(tmp_path: Path) -> None:
    data = encoded(".jpg")
    (tmp_path / "a.jpg").write_bytes(data)
    (tmp_path / "b.jpg").write_bytes(data[:-2] + bytes(7) + data[-2:])
    np.testing.assert_array_equal(decode_image(tmp_path / "b.jpg"), decode_image(tmp_path / "a.jpg"))


def test_what_others_write_while_a_jpeg_is_decoded_is_passed_on(capfd: pytest.CaptureFixture[str]) -> None:
    said: list[str] = []
    with image_file._warnings_of_libjpeg(said):
        os.write(2, b"somebody else\nCorrupt JPEG data: premature end of data segment\n")
    os.write(2, b"behind\n")
    assert said == ["Corrupt JPEG data: premature end of data segment"]
    assert capfd.readouterr().err == "somebody else\nbehind\n"


def test_want_of_memory_is_the_pictures_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(cv2, "imdecode", fail)
    with pytest.raises(InputError, match=r"a\.png: there is not enough memory to decode an image of 256×128 px"):
        decode_picture(encoded(".png"), tmp_path / "a.png", cv2.IMREAD_COLOR)
