"""Which file is the mask of an image."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.names import find_mask, require_masks


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
