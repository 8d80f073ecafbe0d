"""What stands where a run is to write, and is nobody's but the user's, is kept."""

from __future__ import annotations

from pathlib import Path

from tests.engine.conftest import Toy


def backups(toy: Toy) -> dict[str, bytes]:
    return {path.relative_to(toy.folder / "out").as_posix(): path.read_bytes() for path in toy.folder.rglob("*.bak")}


def written_file(toy: Toy) -> Path:
    return next(toy.folder / "out" / name for name in sorted(toy.deliverables()) if not name.startswith("."))


def test_an_edited_deliverable_is_written_anew_and_the_edit_is_kept(toy: Toy) -> None:
    toy.run()
    path = written_file(toy)
    ours = path.read_bytes()
    for edit in (b"by hand", b"by hand again"):
        path.write_bytes(edit)
        result = toy.run()
        assert result.computed == 0
        assert path.read_bytes() == ours
        assert any(f"{path.name} was not as a run had written it" in warning for warning in result.warnings)
    assert sorted(backups(toy).values()) == [b"by hand", b"by hand again"]


def test_files_of_somebody_else_are_kept(toy: Toy) -> None:
    toy.run()
    name = written_file(toy).relative_to(toy.folder / "out")
    (toy.folder / "out").rename(toy.folder / "first")
    path = toy.folder / "out" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"of somebody else")
    toy.run()
    assert path.read_bytes() == (toy.folder / "first" / name).read_bytes()
    assert backups(toy) == {f"{name.as_posix()}.bak": b"of somebody else"}


def test_what_runs_wrote_leaves_no_copies(toy: Toy) -> None:
    toy.run()
    before = toy.deliverables()
    toy.run("scaled.by=5")
    assert toy.deliverables() != before
    toy.run()
    assert toy.deliverables() == before
    assert not backups(toy)
