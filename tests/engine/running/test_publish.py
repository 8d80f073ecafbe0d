"""Where files land: the placeholders of their targets."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import ContractError, UsageError
from pano_mvs.core.files import OUTPUT_MARK
from pano_mvs.engine.cache.store import Store
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
