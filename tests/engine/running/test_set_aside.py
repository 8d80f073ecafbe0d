"""What stands where a run is to write, and is nobody's but the user's, is kept."""

from __future__ import annotations

from pathlib import Path

from tests.engine.conftest import Toy


def backups(toy: Toy) -> dict[str, bytes]:
    return {path.relative_to(toy.folder / "out").as_posix(): path.read_bytes() for path in toy.folder.rglob("*.bak")}


def written_file(toy: Toy) -> Path:
    return next(toy.folder / "out" / name for name in sorted(toy.deliverables()) if not name.startswith("."))


def test_an_edited_deliverable_is_written_anew_and_the_edit_is_kept(finished: Toy) -> None:
    path = written_file(finished)
    ours = path.read_bytes()
    for edit in (b"by hand", b"by hand again"):
        path.write_bytes(edit)
        result = finished.run()
        assert result.computed == 0
        assert path.read_bytes() == ours
        assert any(f"{path.name} was not as a run had written it" in warning for warning in result.warnings)
    assert sorted(backups(finished).values()) == [b"by hand", b"by hand again"]


def test_files_of_somebody_else_are_kept(finished: Toy) -> None:
    name = written_file(finished).relative_to(finished.folder / "out")
    (finished.folder / "out").rename(finished.folder / "first")
    path = finished.folder / "out" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"of somebody else")
    finished.run()
    assert path.read_bytes() == (finished.folder / "first" / name).read_bytes()
    assert backups(finished) == {f"{name.as_posix()}.bak": b"of somebody else"}


def test_what_runs_wrote_leaves_no_copies(finished: Toy) -> None:
    before = finished.deliverables()
    finished.run("scaled.by=5")
    assert finished.deliverables() != before
    finished.run()
    assert finished.deliverables() == before
    assert not backups(finished)
