"""Files that are written in one step, and what is left of those who were killed while they wrote.

Names that files state never lead out of a folder, whatever the name and whatever links are there.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core import files
from pano_mvs.core.errors import InputError, StoreError, UsageError
from pano_mvs.core.file_names import file_inside, item_problem, path_inside
from pano_mvs.core.files import clear_abandoned, make_folder, replacing, temporary_prefix, write_text
from pano_mvs.core.paths import is_inside
from pano_mvs.engine.cache.store import Store
from tests.engine.conftest import Toy
from tests.hostile_names import HOSTILE_NAMES

ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="elsewhere only age tells whether a process is gone")


def of_a_dead_process() -> str:
    code = "from pano_mvs.core.files import temporary_prefix; print(temporary_prefix(), end='')"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@ON_POSIX
def test_leavings_of_dead_processes_go_at_once_and_those_of_others_with_age(tmp_path: Path) -> None:
    dead, here, elsewhere = of_a_dead_process(), temporary_prefix(), ".tmp-00000000-1-"
    assert dead != here
    for prefix in (dead, here, elsewhere, ".tmp-", "tmp-", ".tmp-00000000-99999999999-"):
        (tmp_path / f"{prefix}young").touch()
        (tmp_path / f"{prefix}old").mkdir()
        (tmp_path / f"{prefix}old" / "inside").touch()
        os.utime(tmp_path / f"{prefix}old", (time.time() - 8 * 86400,) * 2)
    (tmp_path / f"{dead}link").symlink_to(tmp_path / f"{here}old")
    clear_abandoned(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {
        f"{here}young",
        f"{here}old",
        f"{elsewhere}young",
        ".tmp-young",
        "tmp-young",
        "tmp-old",
        ".tmp-00000000-99999999999-young",
    }
    assert (tmp_path / f"{here}old" / "inside").exists()
    clear_abandoned(tmp_path / "nowhere")


@ON_POSIX
def test_nothing_half_written_is_left_in_results_or_store(toy: Toy) -> None:
    """What a killed run was writing stayed beside the results for ever, and blocked `cache gc` in the book of runs."""
    toy.run()
    clean, dead = toy.deliverables(), of_a_dead_process()
    root = toy.folder / "cache"
    for folder in (toy.folder / "out", toy.folder / "out" / "mean", root / "tmp"):
        (folder / f"{dead}x.txt").write_text("half")
    toy.run()
    assert toy.deliverables() == clean
    assert not list((root / "tmp").iterdir())


@pytest.mark.parametrize("ahead_s", [0.0, 5 * 365 * 86400.0])
def test_scratch_folders_tell_whose_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ahead_s: float) -> None:
    """A run that started with a clock far ahead removed the folders of units that were being computed."""
    with Store(tmp_path).scratch() as folder:
        assert folder.name.startswith(temporary_prefix())
        now = time.time()
        monkeypatch.setattr(time, "time", lambda: now + ahead_s)
        Store(tmp_path)
        assert folder.is_dir() or os.name != "posix"


@pytest.mark.parametrize("durable", [True, False])
def test_file_is_the_old_one_until_it_is_the_new_one(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "a" / "b.txt"
    write_text(path, "old", durable=durable)

    def fail_half_way() -> None:
        with replacing(path, durable=durable) as temporary:
            temporary.write_text("new")
            assert path.read_text() == "old"
            raise ValueError("half way")

    with pytest.raises(ValueError, match="half way"):
        fail_half_way()
    assert [found.name for found in path.parent.iterdir()] == ["b.txt"]
    write_text(path, "new", durable=durable, temporary_in=tmp_path)
    assert path.read_text() == "new"


def test_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"file.b\.txt cannot be written: Not a directory\. Check the permissions"):
        write_text(tmp_path / "file" / "b.txt", "x")


@pytest.mark.parametrize("place", ["file/b.txt", "file/deep/b.txt"])
def test_a_given_place_that_cannot_be_used_is_a_mistake_of_the_user(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"--to p: cannot be written \(Not a directory\)\. Give another folder"):
        files.write_given(tmp_path / place, "x", "--to p")


def test_a_full_disk_is_no_mistake_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("tempfile.mkstemp", full)
    with pytest.raises(StoreError, match=r"No space left on device\. Free some space"):
        files.write_given(tmp_path / "b.txt", "x", "--to p")


def test_age_of_what_is_gone_is_no_error(tmp_path: Path) -> None:
    assert not files.is_older(tmp_path / "gone", 0)
    files.remove_whole(tmp_path / "gone")


def test_names_of_files_that_are_no_text_can_be_written_of(tmp_path: Path) -> None:
    write_text(tmp_path / "page.html", "of \udcff.png")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == "of \\udcff.png"


@pytest.mark.skipif(os.name != "posix", reason="groups and their permissions are those of POSIX")
def test_what_lies_in_a_folder_of_a_group_is_the_groups_whatever_the_umask(
    toy: Toy,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cache = toy.folder / "cache"
    cache.mkdir()
    cache.chmod(0o2770)
    monkeypatch.setattr(files, "_UMASK", 0o077)
    before = os.umask(0o077)
    try:
        toy.run()
    finally:
        os.umask(before)
    found = {path: path.stat().st_mode & 0o7777 for path in cache.rglob("*")}
    assert not [path for path, mode in found.items() if path.is_dir() and mode != 0o2770]
    assert not [path for path, mode in found.items() if path.is_file() and mode != 0o660]
    assert (toy.folder / "out").stat().st_mode & 0o070 == 0


@pytest.mark.skipif(os.name != "posix", reason="groups and their permissions are those of POSIX")
def test_a_folder_that_another_member_makes_first_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tmp_path.chmod(0o2770)

    def rename(_: Path, target: Path) -> Path:
        target.mkdir()
        raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", rename)
        make_folder(tmp_path / "records")
    assert [path.name for path in tmp_path.iterdir()] == ["records"]
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="directory"):
        make_folder(tmp_path / "file")
    assert not list(tmp_path.glob(".tmp-*"))


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
