"""Where files land: the placeholders of their targets."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import ContractError
from pano_mvs.core.files import OUTPUT_MARK
from pano_mvs.engine.publish import Publisher
from pano_mvs.engine.store import Store
from pano_mvs.scene import Files


def test_item_is_the_name_without_extension_and_name_all_of_it(tmp_path: Path) -> None:
    """Two images that differ in their extensions alone keep them in both."""
    store, publisher = Store(tmp_path / "cache"), Publisher(tmp_path / "out", Store(tmp_path / "cache"))
    names = ["a/1.jpg", "b/{name}.png", "2.jpg", "2.png"]
    publisher.name_items(names)
    for name in names:
        path = tmp_path / "text.txt"
        path.write_text(name)
        publisher.publish("toy", name, store.put_value(Files({"short/{item}.txt": path, "long/{name}.txt": path})))
    assert {path: (tmp_path / "out" / path).read_text() for path in publisher.written} == {
        "short/a/1.txt": "a/1.jpg", "long/a/1.jpg.txt": "a/1.jpg",
        "short/2.jpg.txt": "2.jpg", "long/2.jpg.txt": "2.jpg", "short/2.png.txt": "2.png", "long/2.png.txt": "2.png",
        "short/b/{name}.txt": "b/{name}.png", "long/b/{name}.png.txt": "b/{name}.png",
    }  # fmt: skip


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


@pytest.mark.parametrize("target", ["run.json", "Report.HTML", "logs/{item}.txt", "{item}", ".pano-mvs-output",
                                    "sub/.pano-mvs-output", ".tmp-1-2-x", "run.json/x"])  # fmt: skip
def test_what_is_the_runs_own_is_not_delivered(tmp_path: Path, target: str) -> None:
    store = Store(tmp_path / "cache")
    publisher = Publisher(tmp_path / "out", store)
    publisher.name_items(["report.html.png"])
    path = tmp_path / "text.txt"
    path.write_text("x")
    files = store.put_value(Files({"a.txt": path, target: path}))
    with pytest.raises(ContractError, match="which is the run's own"):
        publisher.publish("toy", "report.html.png", files)
    assert publisher.written == []
    if not target.rpartition("/")[2].startswith("."):  # marks and temporary files are the run's in any folder
        publisher.publish("toy", "report.html.png", files, to="results")
        assert len(publisher.written) == 2
