"""The same picture under two names."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from pano_mvs.io.images.names import match_image_names, pair_image_names


@pytest.mark.parametrize(
    ("wanted", "available", "found"),
    [
        ("1.jpg", ["1.jpg", "a/1.jpg"], "1.jpg"),
        ("1.jpg", ["images/1.jpg", "2.jpg"], "images/1.jpg"),
        ("a/1.jpg", ["1.jpg", "2.jpg"], "1.jpg"),
        ("a/1.jpg", ["x/a/1.jpg", "x/b/1.jpg"], "x/a/1.jpg"),
        ("1.jpg", ["a/1.jpg", "b/1.jpg"], None),
        ("a/1.jpg", ["b/1.jpg", "b/2.jpg"], "b/1.jpg"),
        ("1.jpg", ["./1.png"], "./1.png"),
        ("1.jpg", ["1.png", "1.tif"], None),
        ("a/1.jpg", ["a\\1.jpg"], "a\\1.jpg"),
        ("11.jpg", ["1.jpg", "111.jpg"], None),
        ("x/a/1.jpg", ["y/a/1.jpg", "y/b/1.jpg"], "y/a/1.jpg"),
        ("a/1.jpg", ["1.jpg", "b/a/1.jpg"], "b/a/1.jpg"),
        ("a/1.jpg", ["c/a/1.jpg", "a/1.png"], "c/a/1.jpg"),
        ("v1.5", ["v1.6", "V1.5.jpg"], "V1.5.jpg"),
        ("1.jpg", ["1.bmp"], "1.bmp"),
    ],
)
def test_one_counterpart_is_found_and_two_are_none(wanted: str, available: Sequence[str], found: str | None) -> None:
    assert match_image_names([wanted], available) == ({wanted: found} if found else {})


def test_several_names_may_have_one_counterpart_but_no_pair() -> None:
    assert match_image_names(["a/1", "b/1"], ["1"]) == {"a/1": "1", "b/1": "1"}
    assert pair_image_names(["a/1", "b/1"], ["1"]) == {}
