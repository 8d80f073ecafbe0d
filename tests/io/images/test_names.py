"""The same picture under two names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.names import find_mask, match_image_names, pair_image_names, require_masks


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


@pytest.mark.parametrize(
    ("name", "files", "expected"),
    [
        ("a/b.jpg", ["a/b.jpg.png", "a/b.png"], "a/b.jpg.png"),
        ("a/b.jpg", ["a/b.png", "a/b.tif.png", "b.jpg.png"], "a/b.png"),
        ("a/b.jpg", ["a/b.tif.png"], None),  # the mask of another image
        ("a/b", ["a/b.JPG.png", "a/b.png"], "a/b.JPG.png"),
        ("a/b", ["a/b.png", "a/b.1.png"], "a/b.png"),
        ("b.1", ["b.1.png"], "b.1.png"),
        ("b[1]", ["b[1].jpg.png"], "b[1].jpg.png"),
        ("b", ["c.png"], None),
    ],
)
def test_masks_are_named_as_colmap_names_them_or_like_the_image(
    tmp_path: Path, name: str, files: list[str], expected: str | None
) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(b"")
    assert find_mask(tmp_path, name) == (None if expected is None else tmp_path / expected)


def test_a_folder_without_a_mask_of_any_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.png").write_bytes(b"")
    (tmp_path / "another.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"holds another.png and 1 more.*must be called a.jpg.png, or a.png"):
        require_masks(tmp_path, ["a.jpg"])
    with pytest.raises(InputError, match="must be a folder"):
        require_masks(tmp_path / "other.png", ["a.jpg"])
