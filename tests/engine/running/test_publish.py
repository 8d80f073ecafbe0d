"""The output folder: what is written and removed there, and that one run at a time does so."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pano_mvs.core.errors import ContractError, StoreError, UsageError
from pano_mvs.core.files import OUTPUT_MARK
from pano_mvs.core.locks import try_lock
from pano_mvs.core.processes import start_of
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running import output_lock as module
from pano_mvs.engine.running.output_lock import LOCK_NAME, is_run_gone, output_lock
from pano_mvs.engine.running.publish import Publisher
from pano_mvs.scene import Files


@pytest.fixture
def publisher(tmp_path: Path) -> Publisher:
    return Publisher(tmp_path / "out", Store(tmp_path / "cache"))


def delivered(publisher: Publisher, item: str, *targets: str, to: str = "") -> None:
    path = publisher.out.with_name("text.txt")
    path.write_text(item)
    publisher.publish("toy", item, publisher.store.put_value(Files(dict.fromkeys(targets, path))), to=to)


def files_in(out: Path) -> dict[str, str]:
    files = (path for path in out.rglob("*") if path.is_file() and path.name != OUTPUT_MARK)
    return {path.relative_to(out).as_posix(): path.read_text() for path in files}


def test_item_is_the_name_without_extension_and_name_all_of_it(publisher: Publisher) -> None:
    """Two images that differ in their extensions alone keep them in both."""
    names = ["a/1.jpg", "b/{name}.png", "2.jpg", "2.png"]
    publisher.name_items(names)
    for name in names:
        delivered(publisher, name, "short/{item}.txt", "long/{name}.txt")
    assert files_in(publisher.out) == {
        "short/a/1.txt": "a/1.jpg",
        "long/a/1.jpg.txt": "a/1.jpg",
        "short/2.jpg.txt": "2.jpg",
        "long/2.jpg.txt": "2.jpg",
        "short/2.png.txt": "2.png",
        "long/2.png.txt": "2.png",
        "short/b/{name}.txt": "b/{name}.png",
        "long/b/{name}.png.txt": "b/{name}.png",
    }


def test_folders_that_stale_files_leave_empty_go_with_them(tmp_path: Path) -> None:
    """Only these: what holds anything else stays, and so does an empty folder of somebody else's."""
    out = tmp_path / "out"
    names = ["gone/deep/1.txt", "gone/2.txt", "kept/deep/3.txt", "edited/4.txt", "top.txt"]
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(name)
    publisher = Publisher(out, Store(tmp_path / "cache"))
    earlier = {name: publisher.store.stat_cache.digest(out / name) for name in names}
    for folder in ("theirs", "kept/theirs"):
        (out / folder).mkdir()
    (out / "edited" / "4.txt").write_text("my own notes")
    assert publisher.remove_stale(earlier) == [name for name in names if name != "edited/4.txt"]
    left = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.name != OUTPUT_MARK}
    assert left == {"kept", "kept/theirs", "theirs", "edited", "edited/4.txt"}
    assert publisher.remove_stale({"top.txt": earlier["top.txt"]}) == []
    assert out.is_dir()


def test_an_incomplete_run_deletes_only_files_of_images_that_are_gone(publisher: Publisher) -> None:
    """A capture with one image that is never registered kept the files of renamed images for ever."""
    out = publisher.out
    names = ["range/a.tiff", "range/b.tiff", "range/b.old.tiff", "range/gone.tiff", "range/x/gone.tiff", "cloud.ply"]
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(name)
    earlier = {name: publisher.store.stat_cache.digest(out / name) for name in names}
    publisher.name_items(["a.png", "b.png"])
    publisher.begin_pass()
    delivered(publisher, "a.png", "range/{item}.tiff")
    assert publisher.remove_stale(earlier, complete=False) == ["range/gone.tiff", "range/x/gone.tiff"]
    assert publisher.remove_stale(earlier) == ["range/b.tiff", "range/b.old.tiff", "cloud.ply"]


def test_a_linked_folder_and_what_it_leads_to_stay(tmp_path: Path) -> None:
    out, outside = tmp_path / "out", tmp_path / "outside"
    (out / "real").mkdir(parents=True)
    outside.mkdir()
    (out / "inner").symlink_to(out / "real", target_is_directory=True)
    (out / "outer").symlink_to(outside, target_is_directory=True)
    publisher = Publisher(out, Store(tmp_path / "cache"))
    for folder in (out / "real", outside):
        (folder / "1.txt").write_text("1")
    digest = publisher.store.stat_cache.digest(outside / "1.txt")
    assert publisher.remove_stale({"inner/1.txt": digest, "outer/1.txt": digest}) == ["inner/1.txt"]
    assert (out / "inner").is_dir()
    assert (outside / "1.txt").is_file()


@pytest.mark.parametrize("order", [["a", "b"], ["b", "a"]])
@pytest.mark.parametrize("targets", [{"a": "x", "b": "x"}, {"a": "x", "b": "x/y"}])
def test_units_that_deliver_the_same_file_end_the_run(
    publisher: Publisher, order: list[str], targets: dict[str, str]
) -> None:
    publisher.name_items(["a", "b"])
    delivered(publisher, order[0], targets[order[0]])
    with pytest.raises(UsageError, match=r"stage 'toy' delivers x for a and for b\. Rename one"):
        delivered(publisher, order[1], targets[order[1]])


@pytest.mark.parametrize(
    ("targets", "what"),
    [
        (("{item}.txt", "./{item}.txt"), r"it delivers a\.txt twice"),
        (("{item}.txt", "a.txt"), r"it delivers a\.txt twice"),
        (("b", "b/c.txt"), r"it delivers b as a file and b/c\.txt inside of it"),
    ],
)
def test_a_unit_that_names_a_file_twice_delivers_nothing(
    publisher: Publisher, targets: tuple[str, str], what: str
) -> None:
    publisher.name_items(["a.png"])
    with pytest.raises(ContractError, match=what):
        delivered(publisher, "a.png", *targets)
    assert files_in(publisher.out) == {}


def test_an_image_and_a_folder_of_images_called_alike_do_not_clash(publisher: Publisher) -> None:
    """`000.png` beside `000.tiff/x.png`: a run that wrote TIFF files ended with a message about something else."""
    names = ["000.png", "000.tiff/x.png", "001.png", "b/2.v1.png", "b/2.png/y.png"]
    publisher.name_items(names)
    for name in names:
        delivered(publisher, name, "range/{item}.tiff")
    assert files_in(publisher.out) == {
        "range/000.png.tiff": "000.png",
        "range/000.tiff/x.tiff": "000.tiff/x.png",
        "range/001.tiff": "001.png",
        "range/b/2.v1.tiff": "b/2.v1.png",
        "range/b/2.png/y.tiff": "b/2.png/y.png",
    }


@pytest.mark.parametrize(
    "target",
    [
        "run.json",
        "Report.HTML",
        "logs/{item}.txt",
        "{item}",
        ".pano-mvs-output",
        "sub/.pano-mvs-output",
        ".tmp-1-2-x",
        "run.json/x",
    ],
)
def test_what_is_the_runs_own_is_not_delivered(publisher: Publisher, target: str) -> None:
    publisher.name_items(["report.html.png"])
    with pytest.raises(ContractError, match="which the run itself writes"):
        delivered(publisher, "report.html.png", "a.txt", target)
    assert publisher.written == []
    if not target.rpartition("/")[2].startswith("."):  # marks and temporary files are the run's in any folder
        delivered(publisher, "report.html.png", "a.txt", target, to="results")
        assert len(publisher.written) == 2


ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="elsewhere it is not known whether a process is gone")


def test_a_second_run_is_refused_and_the_lock_goes_with_the_first(tmp_path: Path) -> None:
    with output_lock(tmp_path):
        with (
            pytest.raises(StoreError, match=rf"process {os.getpid()} on .*, since .*\. Wait until it has ended"),
            output_lock(tmp_path),
        ):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]
        assert not is_run_gone(tmp_path)
    assert not list(tmp_path.iterdir())
    assert not is_run_gone(tmp_path)
    with output_lock(tmp_path):
        pass


def test_the_lock_of_a_process_that_was_killed_is_taken_over(tmp_path: Path) -> None:
    code = f"""import os
from pathlib import Path
from pano_mvs.engine.running.output_lock import output_lock
with output_lock(Path({str(tmp_path)!r})): os._exit(9)"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    assert is_run_gone(tmp_path)
    with output_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_NAME).read_bytes())["process"] == os.getpid()
    assert not list(tmp_path.iterdir())


@ON_POSIX
def test_a_killed_run_of_another_user_is_gone_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = os.open

    def as_other(path: Path, flags: int) -> int:
        if flags & os.O_RDWR:
            raise PermissionError
        return opened(path, flags)

    (tmp_path / LOCK_NAME).touch()
    monkeypatch.setattr(os, "access", lambda _path, mode: not mode & os.W_OK)
    monkeypatch.setattr(os, "open", as_other)
    assert is_run_gone(tmp_path)


@pytest.mark.parametrize("text", [b"", b"{", b"[]"])
def test_a_file_that_names_nobody_is_no_obstacle(tmp_path: Path, text: bytes) -> None:
    (tmp_path / LOCK_NAME).write_bytes(text)
    with output_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_NAME).read_bytes())["process"] == os.getpid()


def test_a_file_that_its_owner_has_just_removed_is_not_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, calls = try_lock, []

    def overtaken(handle: int) -> bool | None:
        calls.append(handle)
        if len(calls) == 1:
            (tmp_path / LOCK_NAME).unlink()
        return lock(handle)

    monkeypatch.setattr(module, "try_lock", overtaken)
    with output_lock(tmp_path):
        assert (tmp_path / LOCK_NAME).is_file()
    assert len(calls) == 2


@ON_POSIX
def test_where_open_files_cannot_be_removed_the_file_is_closed_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = os.close
    held: list[bool] = []

    def unlink(_: Path) -> None:
        if held:
            raise PermissionError("it is open")
        os.unlink(tmp_path / LOCK_NAME)  # noqa: PTH108  # as the method does

    def closed(handle: int) -> None:
        close(handle)
        held.clear()

    with output_lock(tmp_path):
        held.append(True)
        monkeypatch.setattr(os, "close", closed)
        monkeypatch.setattr(Path, "unlink", unlink)
        monkeypatch.setattr(os, "name", "nt")
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())


def test_a_file_system_without_locks_stops_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "try_lock", lambda _handle: None)
    with output_lock(tmp_path):
        assert not is_run_gone(tmp_path)


@ON_POSIX
def test_a_link_in_its_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "letter").write_text("dear")
    (tmp_path / LOCK_NAME).symlink_to(tmp_path / "letter")
    with pytest.raises(StoreError, match="cannot be written"), output_lock(tmp_path):
        pass
    assert (tmp_path / "letter").read_text() == "dear"


def test_a_lock_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"), output_lock(tmp_path / "nowhere"):
        pass


@ON_POSIX
def test_the_start_of_a_process_is_its_own() -> None:
    assert start_of(os.getpid()) == start_of(os.getpid()) != ""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert start_of(process.pid) not in (None, "")
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and nobody has taken note
    assert start_of(process.pid) is None
    process.communicate()
    assert start_of(process.pid) is None
