"""The commands that look after a cache: what they show, what they keep, what they leave alone."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import temporary_prefix
from pano_mvs.engine.cache.blobs import BlobStore
from pano_mvs.engine.cache.maintenance import collect
from pano_mvs.engine.cache.store import Store
from tests.engine.conftest import Toy, settle
from tests.engine.running.test_run import ALL_UNITS
from tools.stress.captures import deliverables

Cache = Callable[..., tuple[int, str]]
UNITS = sum(ALL_UNITS.values())


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    """Run a `cache` command on the toy's store."""
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["cache", *arguments, "--cache", str(tmp_path / "cache")])
        return result.exit_code, " ".join(result.output.split())

    return call


def run(toy: Toy, out: str, *options: str) -> tuple[int, str]:
    result = CliRunner().invoke(
        app,
        [*f"run {toy.folder / 'wf.yaml'} --cache {toy.folder / 'cache'} --out {toy.folder / out}".split(), *options],
    )
    return result.exit_code, " ".join(result.output.split())


def files_of(folder: Path) -> dict[str, int]:
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def make_old(folder: Path) -> None:
    for path in folder.rglob("*"):
        os.utime(path, (1e9, 1e9), follow_symlinks=False)


def test_verify_names_what_is_temporary(finished: Toy, cache: Cache) -> None:
    folder = finished.folder / "cache" / "tmp"
    (folder / f"{temporary_prefix()}scratch").mkdir()
    (folder / ".tmp-00000000-7-log.txt").touch()
    (folder / "worker-1.txt").touch()
    code, said = cache("verify")
    assert code == 0
    assert f"scratch (of process {os.getpid()} on this host, which is running)" in said
    assert f"{folder / '.tmp-00000000-7-log.txt'} (of another host or container;" in said
    assert f"{folder / 'worker-1.txt'} (of another version;" in said


@pytest.fixture
def unwritable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Let nothing be written below the caches `cache` and `none`; for root, permissions would not."""
    make = tempfile.mkstemp

    def refuse(*, dir: Path, **options: Any) -> tuple[int, str]:  # noqa: A002
        if Path(dir).is_relative_to(tmp_path / "cache") or Path(dir).is_relative_to(tmp_path / "none"):
            raise PermissionError(13, "Permission denied")
        return make(dir=os.fspath(dir), **options)

    monkeypatch.setattr(tempfile, "mkstemp", refuse)


def test_a_cache_that_can_only_be_read_is_enough_to_plan(
    toy: Toy,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`plan` failed since it could not write down which digests it had found."""
    monkeypatch.setenv("COLUMNS", "200")
    assert run(toy, "out")[0] == 0
    shutil.copyfile(toy.folder / "capture" / "1.txt", toy.folder / "capture" / "6.txt")
    settle(toy.folder / "capture" / "6.txt")
    request.getfixturevalue("unwritable")
    more = ["--out", str(toy.folder / "out")]
    for name in ("cache", "none"):
        for command, *options in (["plan"], ["status"], ["plan", "--explain", "scaled:1.txt"]):
            where = [str(toy.folder / "wf.yaml"), "--cache", str(toy.folder / name)]
            result = CliRunner().invoke(app, [command, *where, *more, *options])
            assert result.exit_code == 0, result.output
    assert "cannot be written" in run(toy, "out", "--cache", str(toy.folder / "none"))[1]
    with pytest.raises(UsageError, match="none cannot be written"):
        Store(toy.folder / "none")


def test_usage_names_every_stage_and_the_whole(finished: Toy, cache: Cache) -> None:
    code, said = cache("du")
    assert code == 0
    assert all(name in said for name in ("toy.source", "toy.scale", "toy.pairs", "toy.mean", "toy.write"))
    on_disk = sum(files_of(finished.folder / "cache").values())
    assert f"{on_disk / 1000:.1f} kB on the disk" in said


def test_runs_are_listed_by_workflow_and_folder(toy: Toy, cache: Cache) -> None:
    for out in ("here", "there", "here"):
        run(toy, out)
    code, said = cache("ls")
    assert code == 0
    assert said.count(str(toy.folder / "here")) == 1
    assert said.count(str(toy.folder / "there")) == 1
    assert said.count(f"│ {UNITS} │") == 2


def test_verification_of_a_sound_cache_ends_well(finished: Toy, cache: Cache) -> None:
    blobs = len(list((finished.folder / "cache" / "blobs").rglob("*.*")))
    assert cache("verify") == (0, f"{UNITS} records and {blobs} blobs are intact, 0 damaged")


def test_verification_removes_what_is_damaged_and_says_what_is_missing(finished: Toy, cache: Cache) -> None:
    root = finished.folder / "cache"
    record = sorted((root / "records").rglob("*.json"))[0]
    record.write_bytes(record.read_bytes()[:-1])
    others = [path.read_text() for path in (root / "records").rglob("*.json") if path != record]
    blob = next(path for path in sorted((root / "blobs").rglob("*.txt")) if any(path.stem in text for text in others))
    blob.write_bytes(b"x" + blob.read_bytes()[1:])
    code, said = cache("verify")
    assert code == 3
    assert f"removed, damaged: {blob}" in said
    assert f"removed, damaged: {record}" in said
    assert "incomplete: " in said
    assert "2 damaged" in said
    assert "the next run computes the missing results again" in said
    assert not record.exists()
    assert not blob.exists()
    finished.run()
    assert cache("verify")[0] == 0


def test_collection_tells_first_and_deletes_when_asked(toy: Toy, cache: Cache) -> None:
    run(toy, "out", "--set", "scaled.by=5")
    run(toy, "out")
    before = files_of(toy.folder / "cache")
    code, said = cache("gc", "--unused", "0s")
    assert code == 0
    assert "would delete: 2" in said
    assert "nothing was deleted; use --delete to delete these results" in said
    assert files_of(toy.folder / "cache") == before
    code, again = cache("gc", "--unused", "0s", "--delete")
    assert again == said.replace("would delete", "deleted").replace(
        " nothing was deleted; use --delete to delete these results", ""
    )
    assert len(files_of(toy.folder / "cache")) < len(before)
    assert "0 units, 0 blobs" in cache("gc", "--unused", "0s")[1]
    assert "(nothing to compute)" in run(toy, "out")[1]
    assert cache("verify")[0] == 0


def test_what_is_young_stays(toy: Toy, cache: Cache) -> None:
    run(toy, "out", "--set", "scaled.by=5")
    run(toy, "out")
    assert "0 units, 0 blobs" in cache("gc", "--delete")[1]
    assert "0 units, 0 blobs" in cache("gc", "--delete", "--unused", "1h")[1]
    make_old(toy.folder / "cache")
    assert "deleted: 2" in cache("gc", "--delete", "--unused", "1h")[1]


def test_two_captures_with_one_workflow_are_both_kept(toy: Toy, cache: Cache) -> None:
    other = toy.folder / "other"
    shutil.copytree(toy.folder / "capture", other)
    (other / "1.txt").write_text("77")
    run(toy, "one")
    run(toy, "two", "--images", str(other))
    assert "0 units, 0 blobs" in cache("gc", "--delete", "--unused", "0s")[1]
    assert "(nothing to compute)" in run(toy, "one")[1]
    assert "(nothing to compute)" in run(toy, "two", "--images", str(other))[1]


def test_failed_units_do_not_expose_the_others(toy: Toy, cache: Cache) -> None:
    toy.number("2.txt", "13")
    assert run(toy, "out")[0] == 3
    assert "0 units, 0 blobs" in cache("gc", "--delete", "--unused", "0s")[1]
    assert toy.run().computed == 0


def test_run_that_did_not_end_keeps_what_its_folder_had(toy: Toy, cache: Cache) -> None:
    """What an unfinished run had not reached was taken from the latest run into any folder, not from its own."""
    run(toy, "mine", "--set", "scaled.by=5")
    run(toy, "other")
    session = toy.session("scaled.by=5")
    store = Store(session.store_root)

    store.runs.remember(session.workflow.id, {}, workflow="toy", out=toy.folder / "mine", finished=False)
    cache("gc", "--delete", "--unused", "0s")
    assert "(nothing to compute)" in run(toy, "mine", "--set", "scaled.by=5")[1]


@pytest.mark.slow
def test_runs_that_are_too_old_are_forgotten_and_pins_are_not(toy: Toy, cache: Cache) -> None:
    run(toy, "pinned", "--set", "scaled.by=5")
    run(toy, "out")
    code, said = cache("pin", str(toy.folder / "pinned"), "good")
    assert code == 0
    assert f"good: {UNITS} units" in said
    assert "good (pin)" in cache("ls")[1]
    code, said = cache("gc", "--delete", "--unused", "0s", "--older-than", "0s")
    assert said.count("run of toy into") == 2
    assert "(nothing to compute)" in run(toy, "pinned", "--set", "scaled.by=5")[1]
    assert f"{UNITS - 5} units computed" not in run(toy, "out")[1]
    cache("gc", "--delete", "--unused", "0s", "--older-than", "0s")
    assert cache("unpin", "good")[0] == 0
    cache("gc", "--delete", "--unused", "0s", "--older-than", "0s")
    assert not list((toy.folder / "cache" / "records").rglob("*.json"))
    assert not [path for path in (toy.folder / "cache" / "blobs").rglob("*") if path.is_file()]


def test_pins_are_asked_for_properly(toy: Toy, cache: Cache) -> None:
    run(toy, "one")
    run(toy, "two", "--set", "scaled.by=5")
    for run_name, name, why in (
        ("nothing", "good", "0 runs match"),
        ("", "good", "the name is empty"),
        (str(toy.folder / "one"), "../x", "not a valid name of a pin"),
        (str(toy.folder / "one"), "", "the name is empty"),
    ):
        code, said = cache("pin", run_name, name)
        assert code == 2
        assert why in said
    assert cache("pin", str(toy.folder / "one"), "good")[0] == 0
    assert cache("pin", str(toy.folder / "one"), "good")[0] == 0
    code, said = cache("pin", str(toy.folder / "two"), "good")
    assert code == 2
    assert "unpin good" in said
    code, said = cache("unpin", "bad")
    assert code == 2
    assert "there are: good" in said


@pytest.mark.parametrize("folder", ["runs", "pins"])
def test_nothing_is_collected_while_what_is_protected_is_not_known(toy: Toy, cache: Cache, folder: str) -> None:
    run(toy, "out")
    cache("pin", str(toy.folder / "out"), "good")
    (entry,) = (toy.folder / "cache" / folder).iterdir()
    entry.write_bytes(entry.read_bytes()[:-2])
    before = files_of(toy.folder / "cache")
    code, said = cache("gc", "--delete", "--unused", "0s")
    assert code == 4
    assert f"{entry} is damaged" in said
    assert files_of(toy.folder / "cache") == before


def test_time_that_is_none_is_refused(finished: Toy, cache: Cache) -> None:
    for option, text in (("--unused", "soon"), ("--older-than", "-3d"), ("--unused", "1")):
        code, said = cache("gc", option, text)
        assert code == 2
        assert "such as 30d" in said


def test_foreign_files_and_links_are_left_alone(finished: Toy, cache: Cache) -> None:
    """A note in the folder of blobs was deleted by `verify` if its name was long, and by `gc` if it was old."""
    root, outside = finished.folder / "cache", finished.folder / "outside"
    outside.mkdir()
    sound = sorted((root / "blobs").rglob("*.json"))[0]
    shutil.copy(sound, outside / "mine.json")
    notes = [
        root / "blobs" / "notes-on-this-capture-of-november-2026.txt",
        root / "records" / "README.txt",
        root / "blobs" / "ab" / "short",
        root / "records" / "zz" / f"{'0' * 32}.json",
        root / "blobs" / "zz" / f"{'0' * 32}.npy",
    ]
    for path in notes:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    links = [
        root / "blobs" / "ab" / f"ab{'0' * 30}.json",
        root / "records" / "ab" / f"ab{'0' * 30}.json",
        root / "blobs" / "xx",
    ]
    for path in links:
        path.parent.mkdir(exist_ok=True)
        path.symlink_to(outside if path.name == "xx" else outside / "mine.json")
    make_old(root)
    make_old(outside)
    code, said = cache("verify")
    assert (code, said.count("not of the cache: ")) == (0, len(notes) + len(links))
    shutil.rmtree(root / "runs")
    assert "deleted: 28 units" in cache("gc", "--delete", "--unused", "0s")[1]
    assert cache("du")[0] == 0
    assert all(path.read_text() == "mine" for path in notes)
    assert all(path.is_symlink() for path in links)
    assert (outside / "mine.json").is_file()


def test_store_with_a_half_written_entry_of_a_killed_run_can_be_collected(finished: Toy, cache: Cache) -> None:
    (finished.folder / "cache" / "runs" / ".tmp-abc.json").write_text("half")
    assert cache("gc")[0] == 0
    assert cache("ls")[0] == 0


@pytest.mark.slow
def test_collection_while_a_run_goes_on_costs_time_at_most(toy: Toy, cache: Cache) -> None:
    """Everything is collected, again and again, while two processes compute; the run heals what it finds gone.

    It does so three times for each file, and then takes the disk to be damaged, so there are three collections.
    """
    toy.begin("time.sleep(0.02)")
    toy.run(cache=toy.folder / "clean")
    clean = deliverables(toy.folder / "out")
    results: list[tuple[int, str]] = []
    thread = threading.Thread(
        target=lambda: results.append(run(toy, "new", "--executor", "processes", "--workers", "2"))
    )
    thread.start()
    collections = 0
    while thread.is_alive():
        if collections < 3 and len(list((toy.folder / "cache" / "records").rglob("*.json"))) > 4:
            collections += 1
            collect(Store(toy.folder / "cache"), unused_s=0.0, forget_after_s=0.0, delete=True)
        time.sleep(0.02)
    thread.join()
    assert collections
    assert results[0][0] == 0, results
    assert deliverables(toy.folder / "new") == clean


def test_verification_while_a_run_writes_reports_nothing_wrong(
    toy: Toy,
    cache: Cache,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Units that end after the blobs were checked were told to be incomplete."""
    from pano_mvs.engine.cache import maintenance as upkeep

    files, listed = upkeep._files, list[str]()

    def and_run_between(folder: Path) -> object:
        listed.append(folder.name)
        if folder.name == "records" and listed.count("records") == 2:  # the first time for foreign files
            toy.run()
        return files(folder)

    Store(toy.folder / "cache")
    monkeypatch.setattr(upkeep, "_files", and_run_between)
    code, said = cache("verify")
    assert (code, said) == (0, f"{UNITS} records and 0 blobs are intact, 0 damaged")


def test_file_that_goes_while_it_is_looked_at_is_no_error(finished: Toy, cache: Cache) -> None:
    from pano_mvs.engine.cache import maintenance as upkeep

    gone = finished.folder / "cache" / "records" / "gone"
    assert upkeep._stat(gone) is None
    assert upkeep._read(gone) is None
    assert upkeep._digest(gone) == ""


def test_blob_that_a_run_came_to_use_is_not_swept(finished: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    root = finished.folder / "cache"
    shutil.rmtree(root / "runs")
    make_old(root)
    store = Store(root)
    from pano_mvs.engine.cache import maintenance as upkeep

    delete = upkeep._delete

    def after_a_use(*arguments: Any, **options: Any) -> None:
        for path in (*root.rglob("*.json"), *root.rglob("*.txt")):
            os.utime(path)
        delete(*arguments, **options)

    before = files_of(root)
    monkeypatch.setattr(upkeep, "_delete", after_a_use)
    collect(store, unused_s=3600.0, delete=True)
    assert files_of(root) == before


def test_store_may_be_reached_through_another_path(finished: Toy, cache: Cache) -> None:
    (finished.folder / "link").symlink_to(finished.folder / "cache")
    assert finished.run(cache=finished.folder / "link").computed == 0
    moved = finished.folder / "moved"
    (finished.folder / "cache").rename(moved)
    assert finished.run(cache=moved).computed == 0
    assert CliRunner().invoke(app, ["cache", "verify", "--cache", str(moved)]).exit_code == 0


def test_folder_that_is_no_cache_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    for command in (["du"], ["ls"], ["verify"], ["gc"], ["pin", "a", "b"], ["unpin", "a"]):
        result = CliRunner().invoke(app, ["cache", *command, "--cache", str(tmp_path)])
        assert result.exit_code == 2
        assert "is not a cache of pano-mvs" in " ".join(result.output.split())
    assert not list(tmp_path.iterdir())


def test_layout_of_another_version_is_refused_by_all_commands(finished: Toy, cache: Cache) -> None:
    for layout in ('{"layout": 4}', "[]", "{}", "1", "[" * 100_000, "\xff"):
        (finished.folder / "cache" / "layout.json").write_text(layout, encoding="latin-1")
        before = files_of(finished.folder / "cache")
        for command in (["du"], ["verify"], ["gc", "--delete", "--unused", "0s"]):
            code, said = cache(*command)
            assert code == 2, layout[:10]
            assert "with --cache DIR" in said
        assert files_of(finished.folder / "cache") == before


@pytest.mark.slow
def test_cache_that_cannot_be_written_says_so(finished: Toy, cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    """By permissions, or, where these do not bind us, by a stand-in of the calls that would fail."""
    root = finished.folder / "cache"
    assert run(finished, "new")[0] == 0
    folders = [path for path in (root, *root.rglob("*")) if path.is_dir()]
    for path in folders:
        path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        if os.access(root, os.W_OK):  # root may write everywhere
            _refuse_writes_below(root, monkeypatch)
        code, said = run(finished, "again")
        assert (code, "(nothing to compute)" in said) == (0, True), said
        code, said = run(finished, "other", "--set", "scaled.by=5", "--executor", "serial")
        assert code == 4
        assert f"cache {root} cannot be written: " in said
        code, said = run(finished, "other", "--set", "scaled.by=5", "--executor", "processes")
        assert code == 4, said
        assert f"{root}" in said
        assert cache("verify")[0] == 0
        code, said = cache("gc", "--delete", "--unused", "0s", "--older-than", "0s")
        assert code == 4
        assert "cannot be deleted: " in said
    finally:
        for path in folders:
            path.chmod(0o755)


def _refuse_writes_below(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tempfile

    def refusing(function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **settings: object) -> object:
            place = Path(str(settings.get("dir") or arguments[0]))
            writes = function is not open_ or (arguments[1:2] and "w" in str(arguments[1]))
            if writes and place.is_relative_to(root) and not (function is mkdir and place.exists()):
                raise PermissionError(13, "Permission denied", str(place))
            return function(*arguments, **settings)

        return call

    open_, mkdir = Path.open, Path.mkdir
    for owner, name in (
        (Path, "open"),
        (Path, "mkdir"),
        (Path, "touch"),
        (Path, "unlink"),
        (tempfile, "mkstemp"),
        (tempfile, "mkdtemp"),
    ):
        monkeypatch.setattr(owner, name, refusing(getattr(owner, name)))


def test_same_bytes_under_two_names_are_each_checked(tmp_path: Path) -> None:
    """A user's picture that had been checked stood for the store's own copy of it."""
    from pano_mvs.engine.cache.blobs import DamagedBlobError
    from pano_mvs.scene import FilePart

    (tmp_path / "a.txt").write_bytes(b"same")
    store = Store(tmp_path / "store")
    inside = store.blobs.put(FilePart(tmp_path / "a.txt"))
    outside = store.blobs.put(FilePart(tmp_path / "a.txt", external=True))
    assert inside.digest == outside.digest == digest_from_bytes(b"same")
    fresh = Store(tmp_path / "store").blobs
    assert isinstance(fresh, BlobStore)
    fresh.register_external(tmp_path / "a.txt")
    fresh.verified_place(outside)
    fresh.path(inside).write_bytes(b"sane")
    with pytest.raises(DamagedBlobError, match="damaged"):
        fresh.verified_place(inside)
