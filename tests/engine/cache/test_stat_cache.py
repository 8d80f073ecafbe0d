"""Digests that are remembered by time stamps: whatever is wrong with the file costs time and nothing else."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.engine.cache import stat_cache
from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.running.run import Run
from tests.engine.cache.test_hostile_store import anything, fuzzing, signed
from tests.engine.conftest import Toy, settle


@pytest.fixture(autouse=True)
def nothing_is_too_young(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stat_cache, "_SETTLE_S", -1.0)


def write(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    settle(path)
    return path


def entries_of(path: Path) -> list[str]:
    return list(json.loads(path.read_bytes().partition(b"\n")[2]))


def test_file_that_is_known_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, "a", b"one")
    first = StatCache(tmp_path / "stat.json")
    digest = first.digest(path)
    first.save()
    monkeypatch.setattr(stat_cache, "digest_from_file", lambda _: pytest.fail("it was read"))
    assert StatCache(tmp_path / "stat.json").digest(path) == digest == digest_from_bytes(b"one")


def test_two_runs_that_learn_at_the_same_time_lose_nothing(tmp_path: Path) -> None:
    """The run that ended last wrote over what the other had learnt."""
    paths = [write(tmp_path, name, name.encode()) for name in ("a", "b", "c")]
    start = StatCache(tmp_path / "stat.json")
    start.digest(paths[0])
    start.save()
    one, other = StatCache(tmp_path / "stat.json"), StatCache(tmp_path / "stat.json")
    one.digest(paths[1])
    other.digest(paths[2])
    other.save()
    one.save()
    assert sorted(entries_of(tmp_path / "stat.json")) == [str(path.resolve()) for path in paths]


def test_what_is_learnt_later_holds(tmp_path: Path) -> None:
    path = write(tmp_path, "a", b"one")
    one, other = StatCache(tmp_path / "stat.json"), StatCache(tmp_path / "stat.json")
    one.digest(path)
    write(tmp_path, "a", b"two!")
    other.digest(path)
    one.save()
    other.save()
    assert StatCache(tmp_path / "stat.json").digest(path) == digest_from_bytes(b"two!")


def test_it_does_not_grow_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stat_cache, "_MAX_ENTRIES", 10)
    for number in range(25):
        cache = StatCache(tmp_path / "stat.json")
        cache.digest(write(tmp_path, f"{number:02d}", b"x"))
        cache.save()
    names = [Path(name).name for name in entries_of(tmp_path / "stat.json")]
    assert names == [f"{number:02d}" for number in range(15, 25)]


def test_every_bit_of_the_file_counts(tmp_path: Path) -> None:
    """A flipped digit of a digest stood for the user's file, which was then damaged again and again."""
    paths = [write(tmp_path, name, name.encode()) for name in ("a", "b")]
    cache = StatCache(tmp_path / "stat.json")
    digests = [cache.digest(path) for path in paths]
    cache.save()
    data = (tmp_path / "stat.json").read_bytes()
    for place in range(0, len(data), 3):
        (tmp_path / "stat.json").write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        again = StatCache(tmp_path / "stat.json")
        assert [again.digest(path) for path in paths] == digests
    (tmp_path / "stat.json").write_bytes(data[: len(data) // 2])
    assert [StatCache(tmp_path / "stat.json").digest(path) for path in paths] == digests


@given(
    data=st.binary(max_size=100) | anything.map(signed) | st.just(b"[" * 9999) | st.just(signed([1])),
    entry=st.lists(anything, min_size=4, max_size=6),
)
@fuzzing
def test_any_file_gives_right_digests(tmp_path: Path, data: bytes, entry: list[object]) -> None:
    path = write(tmp_path, "a", b"one")
    stat = path.stat()
    state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
    for content in (data, signed({str(path): entry}), signed({str(path): [*state, entry[0]]})):
        if content == signed({str(path): [*state, "0" * 32]}):
            continue  # a well made lie: see below
        (tmp_path / "stat.json").write_bytes(content)
        cache = StatCache(tmp_path / "stat.json")
        assert cache.digest(path) == digest_from_bytes(b"one")
        cache.save()
        assert StatCache(tmp_path / "stat.json").digest(path) == digest_from_bytes(b"one")


@pytest.mark.slow
def test_well_made_lie_about_a_file_costs_time_only(toy: Toy) -> None:
    """A digest of other bytes under the right time stamps: what reads the file's bytes through the store notices."""
    toy.edit(
        "plug.py",
        lambda text: (
            text.replace(
                '    """Read a number."""\n    return Number(float(item.files["text"].read_text()))',
                '    """Read a number."""\n    return Text(FilePart(item.files["text"], external=True))',
            )
            .replace(
                "def read(item: SourceItem, params: SourceParams) -> Number:",
                """def read(item: SourceItem, params: SourceParams) -> Text:""",
            )
            .replace(
                "def list_items",
                '''@dataclass(frozen=True, eq=False)
class Text(Record):
    axis: ClassVar[Axis | None] = Axis.IMAGE
    file: FilePart

    def to_parts(self):
        return {"file": self.file}

    @classmethod
    def from_parts(cls, parts):
        return cls(parts["file"])


@stage("toy.parse")
def parse(text: Each[Text]) -> Number:
    """Read the number in a text."""
    return Number(float(text.file.read_bytes()))


def list_items''',
            )
            .replace("import os\n", "import os\nfrom pano_mvs.scene import FilePart\n")
        ),
    )
    toy.edit(
        "wf.yaml",
        lambda text: text.replace("  scaled:  ", "  parsed:     {use: toy.parse}\n  scaled:  ").replace(
            "{names: images}", "{names: parsed}"
        ),
    )
    toy.run()
    clean = toy.deliverables()
    path = toy.folder / "cache" / "stat-cache.json"
    lies = {name: [*entry[:4], "0" * 32] for name, entry in json.loads(path.read_bytes().partition(b"\n")[2]).items()}
    assert len(lies) >= 5
    path.write_bytes(signed(lies))
    session = toy.session()
    store = Store(session.store_root)
    executor = ProcessExecutor(store, workers=1, threads=1)  # what a worker notices, we have to forget
    try:
        result = Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
    finally:
        executor.close()
    assert result.exit_code == 0, (result.failures, result.warnings)
    assert any("capture/1.txt changed during the run" in text for text in result.warnings)
    assert toy.deliverables() == clean


def test_time_stamps_in_the_future_are_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stat_cache, "_SETTLE_S", 2.0)
    path = write(tmp_path, "a", b"one")
    os.utime(path, (time.time() + 100, time.time() + 100))
    cache = StatCache(tmp_path / "stat.json")
    cache.digest(path)
    cache.save()
    assert not (tmp_path / "stat.json").exists()
