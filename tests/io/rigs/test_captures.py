"""The pictures of both lenses are found side by side, in two folders, or by the ends of their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.captures import Layout, list_rig_pictures

LENSES = ("front", "back")


def listed(folder: Path, names: list[str], layout: Layout = "auto") -> list[tuple[str, list[str], str]]:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return [
        (one.name, [path.relative_to(folder).as_posix() for path in one.files], one.problem)
        for one in list_rig_pictures(folder, LENSES, layout)
    ]


def test_folders_of_the_lenses_may_be_anywhere_in_the_path(tmp_path: Path) -> None:
    names = ["hall/back/2.jpg", "hall/front/2.jpg", "hall/front/10.jpg", "hall/back/10.jpg"]
    assert listed(tmp_path, names) == [
        ("hall/2.png", ["hall/front/2.jpg", "hall/back/2.jpg"], ""),
        ("hall/10.png", ["hall/front/10.jpg", "hall/back/10.jpg"], ""),
    ]


def test_suffixes_of_names(tmp_path: Path) -> None:
    assert listed(tmp_path, ["a/1_front.jpg", "a/1_back.jpg", "a/2-back.jpg", "a/2-front.jpg"]) == [
        ("a/1.png", ["a/1_front.jpg", "a/1_back.jpg"], ""),
        ("a/2.png", ["a/2-front.jpg", "a/2-back.jpg"], ""),
    ]


def test_other_files_show_both_lenses(tmp_path: Path) -> None:
    assert listed(tmp_path, ["1.jpg", "2.jpg", "setback.jpg"]) == [
        (f"{name}.png", [f"{name}.jpg"], "") for name in ("1", "2", "setback")
    ]


def test_incomplete_captures_are_reported(tmp_path: Path) -> None:
    assert listed(
        tmp_path, ["front/1.jpg", "back/1.jpg", "back/2.jpg", "notes/3.jpg", "back/4.png", "front/4.jpg"]
    ) == [
        ("1.png", ["front/1.jpg", "back/1.jpg"], ""),
        ("2.png", ["back/2.jpg"], "the picture of the lens front is missing"),
        (
            "4.png",
            ["front/4.jpg", "back/4.png"],
            "the pictures of its lenses have different formats; save both in the same",
        ),
        ("notes/3.jpg", [], "does not belong to a lens: no folders front or back"),
    ]


def test_a_layout_that_fits_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no image belongs to a lens.*front/000\.jpg, or set layout: side_by_side"):
        listed(tmp_path, ["1.jpg"], "folders")
