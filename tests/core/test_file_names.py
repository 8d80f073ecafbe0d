"""Names that files state never lead out of a folder, whatever the name and whatever links are there."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import file_inside, item_problem, path_inside
from pano_mvs.core.paths import is_inside
from tests.hostile_names import HOSTILE_NAMES

PARTS = st.sampled_from(["..", ".", "", "a", "C:", "~", "a.png", "nul", "\\", "\0", "\x1b[2J", " ", "link", "x" * 256])


@given(st.lists(PARTS | st.text(max_size=4), max_size=5), st.sampled_from(["/", "\\", ""]))
def test_paths_stay_inside(parts: list[str], separator: str) -> None:
    folder = Path("/root/of/all")
    name = separator.join(parts)
    try:
        path = path_inside(folder, name)
    except InputError:
        return
    assert is_inside(path, folder)
    assert "\\" not in name


@pytest.mark.parametrize("name", HOSTILE_NAMES)
def test_hostile_names_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.png").touch()
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "outside").symlink_to(tmp_path)
    assert "rename it" in item_problem(name)
    with pytest.raises(InputError, match="rename it"):
        path_inside(folder, name)
    assert file_inside(folder, name) is None


def test_links_that_lead_outside_are_refused_unless_they_are_those_of_images(tmp_path: Path) -> None:
    (tmp_path / "secret.png").touch()
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "outside").symlink_to(tmp_path)
    (folder / "secret.png").symlink_to(tmp_path / "secret.png")
    (folder / "own.png").touch()
    for name in ("outside/secret.png", "secret.png"):
        with pytest.raises(InputError, match="a link leads outside"):
            path_inside(folder, name)
        assert file_inside(folder, name) is None
        assert file_inside(folder, name, through_links=True) == folder / name
    assert file_inside(folder, "own.png") == path_inside(folder, "own.png") == folder / "own.png"


@pytest.mark.parametrize("name", ["x" * 216, "ü" * 108 + ".png", "a/" + "x" * 216 + "/b.png"])
def test_names_too_long_for_their_results_are_refused(name: str) -> None:
    """A name of 255 bytes passed the source and stopped the export at the end of a run."""
    assert "bytes, and 215 are possible" in item_problem(name)
    assert item_problem("x" * 215) == item_problem(f"{'x' * 200}/{'ü' * 100}") == ""
