"""Where a picture was taken, and how a viewer would turn it."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pano_mvs.io.images.captures import describe_picture
from pano_mvs.io.images.metadata import focal_from_exif, orientation_from_exif, position_from_exif, read_container
from tests.io.images.pictures import app1, exif, write_jpeg


@pytest.mark.parametrize("order", ["<", ">"])
def test_position_and_orientation_are_read_in_both_byte_orders(order: str) -> None:
    assert position_from_exif(exif(order)) == pytest.approx((47.51, 8.25, 123.4))
    assert position_from_exif(exif(order, orientation=6)) == pytest.approx((47.51, 8.25, 123.4))
    assert orientation_from_exif(exif(order, orientation=6)) == 6
    assert orientation_from_exif(exif(order)) == 1
    assert orientation_from_exif(exif(order, orientation=77)) == 1


def test_south_west_and_below_the_sea_are_negative() -> None:
    assert position_from_exif(exif(refs=(b"S", b"W", 1))) == pytest.approx((-47.51, -8.25, -123.4))


@pytest.mark.parametrize(
    "change",
    [
        {"latitude": ((0, 0), (0, 0), (0, 0))},
        {"latitude": ((91, 1), (0, 1), (0, 1))},
        {"longitude": ((181, 1), (0, 1), (0, 1))},
        {"altitude": (0, 0)},
    ],
)
def test_what_is_no_position_is_none(change: dict[str, Any]) -> None:
    assert position_from_exif(exif(**change)) is None


@given(st.binary(max_size=12), st.integers(0, 180), st.integers(0, 180))
@settings(max_examples=300, deadline=None)
def test_damage_is_never_a_crash(noise: bytes, offset: int, cut: int) -> None:
    data = exif()
    damaged = (data[:offset] + noise + data[offset + len(noise) :])[: len(data) - cut]
    position = position_from_exif(damaged)
    assert 1 <= orientation_from_exif(damaged) <= 8
    assert position is None or (abs(position[0]) <= 90 and abs(position[1]) <= 180)


def test_a_picture_tells_where_it_was_taken(tmp_path: Path) -> None:
    assert describe_picture(write_jpeg(tmp_path / "a.jpg", (32, 64))).position_lla is None
    info = describe_picture(write_jpeg(tmp_path / "b.jpg", (32, 64), segments=app1(b"Exif\0\0" + exif())))
    assert info.position_lla == pytest.approx((47.51, 8.25, 123.4))


def test_an_entry_that_points_outside_of_the_data_hides_no_others() -> None:
    """Pillow stops at such an entry, and the position behind it is lost."""
    data = exif(orientation=6)
    description = struct.pack("<HHII", 0x010E, 2, 40, 1_000_000)
    damaged = data[:10] + description + data[22:]
    assert position_from_exif(damaged) == pytest.approx((47.51, 8.25, 123.4))


def test_the_focal_length_is_that_of_35_mm_film(tmp_path: Path) -> None:
    """24 mm on film is a diagonal field of view of 84°."""
    metadata = Image.Exif()
    metadata.get_ifd(0x8769)[0xA405] = 24
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=metadata)
    focal_px = focal_from_exif(read_container((tmp_path / "a.jpg").read_bytes()).exif, (300, 400))
    assert focal_px is not None
    assert math.degrees(2 * math.atan(250 / focal_px)) == pytest.approx(84.06, abs=0.05)
    assert focal_from_exif(exif(), (300, 400)) is None
    assert focal_from_exif(b"", (300, 400)) is None
