"""Digests of values, bytes and files: equal for what is equal, other for all else, on every machine."""

from __future__ import annotations

import io
from collections import OrderedDict
from pathlib import Path
from types import MappingProxyType

import pytest

from pano_mvs.core.digest import IS_DIGEST, digest_from_bytes, digest_from_file, digest_from_stream, digest_from_value
from pano_mvs.core.errors import UsageError


@pytest.mark.parametrize(
    ("value", "digest"),
    [
        (None, "81f82811a1ccf128a929de0099985537"),
        ([True, 2, 2.5, "ä", b"\0"], "97361f7cab44caf47ab6c25dbf8415f4"),
        ({"b": {"x": ()}, "a": -1}, "b3cab9106c237333aa54e2972aec20da"),
    ],
)
def test_digests_stay_as_they_are_from_version_to_version(value: object, digest: str) -> None:
    """Where they change, everything in every cache is computed anew."""
    assert digest_from_value(value) == digest


def test_values_of_different_types_and_borders_differ() -> None:
    values: list[object] = [
        None,
        False,
        True,
        0,
        1,
        -1,
        10,
        0.0,
        1.0,
        -1.0,
        1e-300,
        5e-324,
        "",
        "0",
        "1",
        "None",
        b"",
        b"1",
        [],
        {},
        [[]],
        ["a", "b"],
        ["ab"],
        ["a", ["b"]],
        [["a"], "b"],
        {"a": "b"},
        {"ab": ""},
        {"a": {"b": 1}},
        {"a": 1, "b": 2},
        ["a", 1, "b", 2],
        2**70,
        [1, 2, 3],
        [1, 23],
        [12, 3],
        0.1,
        0.1 + 2**-55,
        "s1:a",
        "a\0",
        "a",
    ]
    assert len({digest_from_value(value) for value in values}) == len(values)


def test_equal_values_in_other_containers_are_equal() -> None:
    assert digest_from_value((1, (2, "a"))) == digest_from_value([1, [2, "a"]])
    assert digest_from_value(-0.0) == digest_from_value(0.0)
    plain = digest_from_value({"a": 1, "b": 2})
    assert digest_from_value(OrderedDict(b=2, a=1)) == plain
    assert digest_from_value(MappingProxyType({"b": 2, "a": 1})) == plain


@pytest.mark.parametrize("value", [float("-inf"), float("nan"), [{"a": float("inf")}]])
def test_numbers_that_are_none_are_refused(value: object) -> None:
    with pytest.raises(UsageError, match="cannot be part of a cache key"):
        digest_from_value(value)


@pytest.mark.parametrize("value", [1j, {1, 2}, Path("a"), bytearray(b"a"), object])
def test_other_types_are_named(value: object) -> None:
    with pytest.raises(UsageError, match=f"a {type(value).__name__} has no canonical form"):
        digest_from_value({"a": value})


@pytest.mark.parametrize("size", [0, 5, 1 << 20, (1 << 20) + 1, 3 << 20])
def test_bytes_files_and_streams_have_one_digest(tmp_path: Path, size: int) -> None:
    data = bytes(range(256)) * (size // 256) + b"x" * (size % 256)
    (tmp_path / "a").write_bytes(data)
    digest = digest_from_bytes(data)
    assert IS_DIGEST.fullmatch(digest)
    assert digest == digest_from_bytes(memoryview(data)) == digest_from_file(tmp_path / "a")
    stream = io.BytesIO(b"before" + data)
    stream.seek(6)
    assert digest_from_stream(stream) == digest
    assert digest != digest_from_bytes(data + b"x")


@pytest.mark.parametrize("text", ["", "0" * 31, "0" * 33, "G" * 32, "A" * 32, "0" * 32 + "\n"])
def test_what_is_no_digest_is_not_taken_for_one(text: str) -> None:
    assert not IS_DIGEST.fullmatch(text)


def test_a_large_value_has_the_digest_of_its_canonical_form() -> None:
    """The form is passed on in pieces, so that a list of a million names does not exist a second time as text."""
    count = 25_000
    form = b"l%d:" % count + b"".join(b"l2:i%d;s1:a" % number for number in range(count))
    assert digest_from_value([[number, "a"] for number in range(count)]) == digest_from_bytes(form)
