"""Where a picture was taken."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pano_mvs.io.captures import describe_picture
from pano_mvs.io.exif_gps import find_gps
from tests.io.pictures import write_jpeg


def rational(order, *pairs):
    return b"".join(struct.pack(order + "II", above, below) for above, below in pairs)


def exif(order="<", *, refs=(b"N", b"E", 0), latitude=None, longitude=None, altitude=(1234, 10)):
    """A TIFF directory with one entry, the GPS directory, and that with six."""
    latitude = latitude or ((47, 1), (30, 1), (3600, 100))
    longitude = longitude or ((8, 1), (15, 1), (0, 1))
    at = 8 + 2 + 12 + 4  # behind the header and the first directory
    values = at + 2 + 6 * 12 + 4
    header = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "HI", 42, 8)
    first = struct.pack(order + "HHHII", 1, 0x8825, 4, 1, at) + bytes(4)
    entries = [
        struct.pack(order + "HHI", 1, 2, 2) + refs[0].ljust(4, b"\0"),
        struct.pack(order + "HHII", 2, 5, 3, values),
        struct.pack(order + "HHI", 3, 2, 2) + refs[1].ljust(4, b"\0"),
        struct.pack(order + "HHII", 4, 5, 3, values + 24),
        struct.pack(order + "HHI", 5, 1, 1) + bytes([refs[2], 0, 0, 0]),
        struct.pack(order + "HHII", 6, 5, 1, values + 48),
    ]
    gps = struct.pack(order + "H", 6) + b"".join(entries) + bytes(4)
    return header + first + gps + rational(order, *latitude, *longitude, altitude)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mark", [b"\xff\xd8\xff\xe1\0\0Exif\0\0", b"\x89PNG\r\n\x1a\n\0\0\0\0eXIf"])
def test_position_is_read_in_both_byte_orders_from_both_containers(order, mark):
    assert find_gps(mark + exif(order)) == pytest.approx((47.51, 8.25, 123.4))


def test_south_west_and_below_the_sea_are_negative():
    assert find_gps(b"Exif\0\0" + exif(refs=(b"S", b"W", 1))) == pytest.approx((-47.51, -8.25, -123.4))


@pytest.mark.parametrize(
    "change", [{"latitude": ((0, 0), (0, 0), (0, 0))}, {"latitude": ((91, 1), (0, 1), (0, 1))},
               {"longitude": ((181, 1), (0, 1), (0, 1))}, {"altitude": (0, 0)}]
)  # fmt: skip
def test_what_is_no_position_is_none(change):
    assert find_gps(b"Exif\0\0" + exif(**change)) is None


@given(st.binary(max_size=12), st.integers(0, 180), st.integers(0, 180))
@settings(max_examples=300, deadline=None)
def test_damage_is_never_a_crash(noise, offset, cut):
    data = exif()
    damaged = (data[:offset] + noise + data[offset + len(noise) :])[: len(data) - cut]
    position = find_gps(b"Exif\0\0" + damaged)
    assert position is None or (abs(position[0]) <= 90 and abs(position[1]) <= 180)


def test_a_picture_tells_where_it_was_taken(tmp_path):
    data = write_jpeg(tmp_path / "a.jpg", (32, 64)).read_bytes()
    assert describe_picture(tmp_path / "a.jpg").position_lla is None
    payload = b"Exif\0\0" + exif()
    (tmp_path / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:])
    assert describe_picture(tmp_path / "a.jpg").position_lla == pytest.approx((47.51, 8.25, 123.4))
