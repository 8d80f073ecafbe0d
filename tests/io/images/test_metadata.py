"""GPano metadata, in all forms in which they occur, and in those in which they should not."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.io.images.captures import describe_picture
from pano_mvs.io.images.metadata import (
    GPano,
    camera_from_exif,
    find_gpano,
    focal_from_exif,
    orientation_from_exif,
    position_from_exif,
    read_container,
)
from tests.io.images.pictures import app1, exif, full_sphere, gpano_of, sound_files, write_jpeg, write_png, xmp

FIELDS = full_sphere(32, 64, PoseHeadingDegrees="180.0", PosePitchDegrees="1.4", PoseRollDegrees="-2.5")
SOUND = sound_files((32, 64), xmp(FIELDS))
EXPECTED = GPano("equirectangular", (32, 64), (0, 0, 64, 32), 180.0, 1.4, -2.5)


@pytest.mark.parametrize("form", ["element", "attribute"])
@pytest.mark.parametrize("wrapped", [True, False])
def test_elements_and_attributes_are_read_from_a_jpeg(tmp_path: Path, form: str, wrapped: bool) -> None:
    path = write_jpeg(tmp_path / "a.jpg", (32, 64), xmp(FIELDS, form=form, wrapped=wrapped))
    assert gpano_of(path) == EXPECTED


@pytest.mark.parametrize("compressed", [True, False])
def test_they_are_read_from_a_png(tmp_path: Path, compressed: bool) -> None:
    path = write_png(tmp_path / "a.png", (32, 64), xmp(FIELDS), compressed=compressed)
    assert gpano_of(path) == EXPECTED


def test_a_picture_without_them_has_none(tmp_path: Path) -> None:
    assert gpano_of(write_jpeg(tmp_path / "a.jpg", (32, 64))) is None
    assert find_gpano((), write_png(tmp_path / "a.png", (32, 64)).read_bytes()) == (None, ())
    other = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a b="c"/></x:xmpmeta>'
    assert find_gpano([other]) == (None, ())


def test_the_packet_that_has_the_fields_is_found_behind_others(tmp_path: Path) -> None:
    other = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a b="c"/></x:xmpmeta>'
    broken = b"<x:xmpmeta><unclosed></x:xmpmeta>"
    gpano, warnings = find_gpano([other, broken], broken + xmp(FIELDS))
    assert gpano == EXPECTED
    assert len(warnings) == 1
    assert "malformed" in warnings[0]


def test_entities_are_refused() -> None:
    bomb = b'<x:xmpmeta xmlns:x="a"><!DOCTYPE a [<!ENTITY b "c">]>' + xmp(FIELDS)[12:]
    gpano, warnings = find_gpano([bomb])
    assert gpano is None
    assert "declares XML entities" in warnings[0]


@pytest.mark.parametrize(
    ("change", "warned", "expected"),
    [
        ({"PosePitchDegrees": "steep"}, "PosePitchDegrees is 'steep'", {"pitch_deg": None}),
        ({"PosePitchDegrees": "nan"}, "PosePitchDegrees is 'nan'", {"pitch_deg": None}),
        ({"CroppedAreaLeftPixels": "-10"}, "CroppedAreaLeftPixels is -10", {"crop_ltwh": (None, 0, 64, 32)}),
        ({"FullPanoWidthPixels": "0"}, "FullPanoWidthPixels is 0", {"full_size_hw": (32, None)}),
    ],
)
def test_a_field_that_makes_no_sense_is_left_out(change: dict[str, str], warned: str, expected: dict[str, Any]) -> None:
    gpano, warnings = find_gpano([xmp(FIELDS | change)])
    assert gpano == GPano(**{**vars(EXPECTED), **expected})
    assert warned in "".join(warnings)


@given(st.sampled_from(SOUND), st.binary(max_size=300), st.integers(0, 900), st.integers(0, 40))
@settings(max_examples=300, deadline=None)
def test_damage_is_never_a_crash(data: bytes, noise: bytes, offset: int, cut: int) -> None:
    """Bytes overwritten at any place, and the rest cut off."""
    damaged = data[:offset] + noise + data[offset + len(noise) : len(data) - cut]
    gpano, warnings = find_gpano(read_container(damaged).xmp, damaged)
    assert gpano is None or isinstance(gpano, GPano)
    assert all(isinstance(warning, str) for warning in warnings)


@given(st.floats(-89, 89), st.floats(-179, 179))
def test_up_is_a_unit_vector_turned_by_roll_and_pitch(pitch_deg: float, roll_deg: float) -> None:
    up = np.array(GPano(pitch_deg=pitch_deg, roll_deg=roll_deg).up_in_cam)
    by_turns = rotation_from_rotvec((np.radians(pitch_deg), 0, 0)) @ (0, -np.cos(np.radians(roll_deg)), 0)
    expected = by_turns * (1, 1, -1) + (-np.sin(np.radians(roll_deg)), 0, 0)
    assert up == pytest.approx(expected, abs=1e-12)
    assert np.linalg.norm(up) == pytest.approx(1)


def test_a_level_camera_has_up_at_its_zenith() -> None:
    assert GPano(pitch_deg=0.0, roll_deg=0.0).up_in_cam == pytest.approx((0, -1, 0))
    assert GPano(pitch_deg=3.0).up_in_cam is None


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


def test_the_camera_is_its_make_and_model(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = "RICOH\0", "RICOH THETA S"
    Image.new("RGB", (4, 2)).save(tmp_path / "a.jpg", exif=tags)
    assert camera_from_exif(read_container((tmp_path / "a.jpg").read_bytes()).exif) == "RICOH RICOH THETA S"
    assert camera_from_exif(exif()) == ""
    assert camera_from_exif(b"") == ""
