"""What is stored comes back as it was; what is damaged is noticed, removed and computed again."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.lib import format as npy
from numpy.typing import NDArray

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import ChangedFileError, ContractError, StoreError, UsageError
from pano_mvs.core.files import CACHE_MARK
from pano_mvs.core.processes import process_place
from pano_mvs.engine.cache import store as store_module
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.maintenance import collect, verify
from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.engine.cache.store import MIN_FREE_BYTES, ItemRef, Store, UnitRecord, record_from_bytes
from pano_mvs.engine.running import run as run_module
from pano_mvs.engine.running.events import RunEvent, StageStarted
from pano_mvs.scene import Features, FilePart, Part, RangeMap, Record
from tests.engine.conftest import Toy, settle
from tests.permissions import permissions_hold


@dataclass(frozen=True, eq=False)
class Sample(Record):
    """A kind for this test."""

    array: NDArray[np.float32]
    names: tuple[str, ...]
    nested: tuple[tuple[str, int], ...]
    share: float


def test_values_come_back_as_they_were(tmp_path: Path) -> None:
    store = Store(tmp_path)
    value = Sample(np.arange(6, dtype=np.float32).reshape(2, 3), ("a", "b"), (("x", 1),), 0.1)
    back = store.load(store.put_value(value), Sample)
    assert isinstance(back, Sample)
    np.testing.assert_array_equal(back.array, value.array)
    assert (back.names, back.nested, back.share) == (value.names, value.nested, value.share)
    assert not back.array.flags.writeable


@pytest.mark.parametrize("shape", [(0, 3), (), (3, 5), (3, 100_000)])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["uint8", "int32", "float64"])
def test_arrays_of_any_form_come_back_read_only(
    tmp_path: Path, shape: tuple[int, ...], order: Literal["C", "F"], dtype: str
) -> None:
    blobs = Store(tmp_path).blobs
    count = int(np.prod(shape))
    array: NDArray[Any] = np.asarray(np.arange(count).astype(np.dtype(dtype)).reshape(shape, order=order))
    ref = blobs.put(array)
    assert ref.is_mapped == (array.nbytes > 200_000)
    back = blobs.get(ref)
    assert isinstance(back, np.ndarray)
    assert isinstance(back, np.memmap) == ref.is_mapped
    assert back.dtype == array.dtype
    assert not back.flags.writeable
    assert back.flags.aligned
    np.testing.assert_array_equal(back, array)


def test_equal_values_share_blobs_and_digest(tmp_path: Path) -> None:
    first, second = Store(tmp_path / "a"), Store(tmp_path / "b")
    value = Sample(np.ones((2, 2), np.float32), (), (), 1.0)
    assert first.put_value(value) == second.put_value(value)


def test_value_that_breaks_its_kind_is_refused(tmp_path: Path) -> None:
    wrong = RangeMap(np.zeros((2, 4), np.float32), np.ones((2, 4), np.uint8))
    with pytest.raises(ContractError, match="invalid is NaN"):
        Store(tmp_path).put_value(wrong)


@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_damaged_blobs_are_noticed_and_computed_again(finished: Toy, damage: str) -> None:
    clean = finished.deliverables()
    blobs = sorted(p for p in (finished.folder / "cache" / "blobs").rglob("*") if p.is_file())
    for blob in blobs:
        data = blob.read_bytes()
        match damage:
            case "flip":
                blob.write_bytes(bytes([data[0] ^ 1]) + data[1:])
            case "truncate":
                blob.write_bytes(data[:-1])
            case "delete":
                blob.unlink()
    (finished.folder / "out" / "all.txt").unlink()
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 3.0"))
    result = finished.run()
    assert result.exit_code == 0
    assert finished.deliverables() == clean
    for blob in blobs:
        assert blob.is_file()


def test_read_of_a_flipped_blob_is_refused_and_removes_it(tmp_path: Path) -> None:
    ref = Store(tmp_path).put_value(Sample(np.ones((2, 2), np.float32), (), (), 1.0))
    path = Store(tmp_path).blobs.path(ref.parts["array"])
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 128]))
    with pytest.raises(DamagedBlobError, match="damaged"):
        Store(tmp_path).load(ref, Sample)
    assert not path.exists()


def test_caches_are_marked_also_those_of_earlier_versions(tmp_path: Path) -> None:
    Store(tmp_path / "a")
    mark = tmp_path / "a" / CACHE_MARK
    assert mark.read_bytes() == b""
    mark.unlink()
    tmp_path.joinpath("a").chmod(0o500)
    with permissions_hold():
        Store(tmp_path / "a")  # a cache that may only be read stays as it is
    assert not mark.exists()
    tmp_path.joinpath("a").chmod(0o700)
    Store(tmp_path / "a")
    assert mark.exists()


@pytest.mark.slow
def test_much_damage_takes_few_passes(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each damaged blob made the run start over: hundreds of them in a large capture took hours."""
    for number in range(6, 20):
        toy.number(f"{number}.txt", str(10 * number))
    toy.run()
    clean = toy.deliverables()
    root = toy.folder / "cache"
    for blob in (root / "blobs").rglob("*.*"):
        blob.write_bytes(b"x" * blob.stat().st_size)
    for record in (root / "records").rglob("*.json"):
        if b'"stage": "toy.mean"' in record.read_bytes() or b'"stage": "toy.write' in record.read_bytes():
            record.unlink()
    passes: list[str] = []

    def note(event: RunEvent | None) -> None:
        if isinstance(event, StageStarted):
            passes.append(event.stage)

    with monkeypatch.context() as listening:
        listening.setattr(run_module, "ignore", note)
        result = toy.run()
    assert result.exit_code == 0
    assert toy.deliverables() == clean
    assert len(result.warnings) > 19
    assert passes.count("images") < 8


def test_input_that_is_gone_while_a_stage_reads_it_is_no_fault_of_the_stage(toy: Toy) -> None:
    """As when somebody collects it in that very moment."""
    mark, blobs = toy.folder / "mark", toy.folder / "cache" / "blobs"
    toy.begin(f"""
import pathlib, shutil
if not (mark := pathlib.Path({str(mark)!r})).exists():
    mark.touch()
    shutil.rmtree({str(blobs)!r})
    raise FileNotFoundError("no such file")
""")
    result = toy.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert any("is missing; the same command computes it again" in text for text in result.warnings)
    assert mark.exists()


KEY = "ab" * 16


@dataclass(frozen=True, eq=False)
class Pair(Record):
    """A kind for these tests."""

    array: np.ndarray
    names: tuple[object, ...]


@dataclass(frozen=True, eq=False)
class Later(Pair):
    """Another kind with the same parts."""

    kind_version = 2


def record_of(store: Store, key: str = KEY) -> UnitRecord:
    first, second = (store.put_value(Pair(np.arange(number), ("a",))) for number in (3, 4))
    metrics, notes, rejected, doubts = {"share": 0.25}, ("a note",), {"b": "blurred"}, {"a": "far"}
    return UnitRecord(key, {"stage": "s"}, first, {"a": second}, metrics, notes, rejected, doubts, 1.5)


def test_a_record_is_found_as_it_was_put_from_any_store_of_the_folder(tmp_path: Path) -> None:
    store = Store(tmp_path)
    record = record_of(store)
    assert store.find(KEY) is None
    assert store.read_record(KEY) is None
    store.put(record)
    for one in (store, Store(tmp_path)):
        assert one.find(KEY) == record
        assert one.damaged == []
    assert store.record_path(KEY) == tmp_path / "records" / "aba" / f"{KEY}.json"
    assert store.record_path(KEY).is_file()
    store.drop(KEY)
    store.drop(KEY)
    assert store.find(KEY) is None


@pytest.mark.parametrize("which", ["output", "item"])
def test_a_record_without_one_of_its_blobs_is_read_but_not_found(tmp_path: Path, which: str) -> None:
    store = Store(tmp_path)
    record = record_of(store)
    store.put(record)
    ref = record.output if which == "output" else record.items["a"]
    store.blobs.path(ref.parts["array"]).unlink()
    assert store.find(KEY) is None
    assert store.read_record(KEY) == record


def test_a_record_under_another_key_is_damage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.put(record_of(store))
    other = "ab" * 15 + "cd"
    store.record_path(KEY).rename(store.record_path(other))
    assert store.find(other) is None
    assert store.damaged == [str(store.record_path(other))]


def record_json(**changes: object) -> dict[str, object]:
    value: dict[str, object] = {
        "key": KEY,
        "identity": {},
        "output": {"kind": "K", "digest": "d" * 32, "parts": {}},
        "items": {},
        "metrics": {},
        "notes": [],
        "rejected": {},
        "doubts": {},
        "seconds": 1,
    }
    return value | changes


def signed(value: object) -> bytes:
    body = json.dumps(value).encode()
    return digest_from_bytes(body).encode() + b"\n" + body


def test_records_of_earlier_versions_are_read() -> None:
    old = record_json()
    del old["doubts"]
    record = record_from_bytes(signed(old))
    assert record is not None
    assert record.doubts == {}
    assert type(record.seconds) is float


@pytest.mark.parametrize(
    "changes",
    [
        {"identity": []},
        {"rejected": []},
        {"doubts": []},
        {"metrics": {"a": float("inf")}},
        {"seconds": float("nan")},
        {"output": {"kind": "K", "digest": "D" * 32, "parts": {}}},
    ],
)
def test_a_record_with_something_else_in_it_is_none(changes: dict[str, object]) -> None:
    assert record_from_bytes(signed(record_json())) is not None
    assert record_from_bytes(signed(record_json(**changes))) is None


def test_a_value_s_digest_depends_on_its_kind_its_version_and_its_parts_alone(tmp_path: Path) -> None:
    store = Store(tmp_path)
    value = Pair(np.arange(3), ("a",))
    ref = store.put_value(value)
    assert ref.kind == "Pair"
    assert store.put_value(replace(value)).digest == ref.digest
    assert store.put_value(replace(value, names=("b",))).digest != ref.digest
    assert store.put_value(replace(value, array=np.arange(3.0))).digest != ref.digest
    later = Later(value.array, value.names)
    assert store.put_value(later).digest != ref.digest
    renamed = type("Pair", (Later,), {"__module__": __name__})
    assert store.put_value(renamed(value.array, value.names)).digest not in {ref.digest, store.put_value(later).digest}


def test_a_value_s_digest_stays_as_it_is_from_version_to_version(tmp_path: Path) -> None:
    """Where it changes, everything that reads the value is computed anew."""
    value = Pair(np.arange(3, dtype=np.int32), ("a", 1.5))
    assert Store(tmp_path).put_value(value).digest == "1702e87db0d51366ab4dde6fe56b88cd"


@pytest.mark.parametrize("what", [float("nan"), object(), 1j])
def test_a_value_that_cannot_be_stored_breaks_the_contract_of_its_kind(tmp_path: Path, what: object) -> None:
    with pytest.raises(ContractError, match="Pair holds something that cannot be stored"):
        Store(tmp_path).put_value(Pair(np.arange(3), (what,)))
    with pytest.raises(ContractError, match="Pair holds something that cannot be stored: an array of Python objects"):
        Store(tmp_path).put_value(Pair(np.array([what], object), ()))


def test_parts_that_make_no_value_are_removed_and_reported(tmp_path: Path) -> None:
    store = Store(tmp_path)
    parts = {name: store.blobs.put(part) for name, part in {"array": np.arange(3), "other": np.arange(4)}.items()}
    with pytest.raises(DamagedBlobError, match=r"is not a part of a Pair; the same command computes it again"):
        store.load(ItemRef("Pair", "d" * 32, parts), Pair)
    assert not any(store.blobs.exists(ref) for ref in parts.values())
    assert len(store.damaged) == 1


def test_a_value_read_as_another_kind_stays(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ref = store.put_value(Pair(np.arange(3), ("a",)))
    with pytest.raises(ContractError, match="a stored Pair was read as a Features"):
        store.load(ref, Features)
    assert store.load(ref, Pair)
    assert not store.damaged


def test_a_blob_is_there_if_its_size_is(tmp_path: Path) -> None:
    blobs = Store(tmp_path).blobs
    ref = blobs.put({"a": 1})
    assert blobs.exists(ref)
    assert blobs.path(ref) == tmp_path / "blobs" / ref.digest[:3] / f"{ref.digest}.json"
    assert not blobs.exists(replace(ref, size_bytes=ref.size_bytes + 1))
    assert not blobs.exists(replace(ref, digest="0" * 32))
    assert not blobs.exists(replace(ref, external=True))
    assert ref.digest == digest_from_bytes(blobs.path(ref).read_bytes()) == digest_from_bytes(b'{"a":1}')
    assert BlobRef.from_json(json.loads(json.dumps(ref.to_json()))) == ref


@pytest.mark.parametrize(("size", "is_one"), [(0, True), ((1 << 50) - 1, True), (1 << 50, False), (-1, False)])
def test_references_name_sizes_that_a_file_can_have(size: int, is_one: bool) -> None:
    value = [KEY, size, ".npy", False]
    if is_one:
        assert BlobRef.from_json(value).to_json() == value
    else:
        with pytest.raises(ValueError, match=rf"^a blob of {size} bytes$"):
            BlobRef.from_json(value)


@pytest.mark.parametrize(
    ("size", "suffix", "external", "mapped"),
    [
        (1 << 18, ".npy", False, True),
        ((1 << 18) - 1, ".npy", False, False),
        (1 << 20, ".json", False, False),
        (1 << 20, ".npy", True, False),
    ],
)
def test_large_arrays_of_the_store_are_mapped(size: int, suffix: str, external: bool, mapped: bool) -> None:
    assert BlobRef(KEY, size, suffix, external).is_mapped is mapped


def test_files_are_copied_and_a_users_own_are_not(tmp_path: Path) -> None:
    blobs = Store(tmp_path / "store").blobs
    path = tmp_path / "Picture.JPG"
    path.write_bytes(b"abc")
    settle(path)
    inside, outside = blobs.put(FilePart(path)), blobs.put(FilePart(path, external=True))
    assert (inside.suffix, inside.size_bytes, inside.external) == (".jpg", 3, False)
    assert (outside.suffix, outside.size_bytes, outside.external) == (".jpg", 3, True)
    assert inside.digest == outside.digest == digest_from_bytes(b"abc")
    assert blobs.path(inside).read_bytes() == b"abc"
    assert blobs.path(outside) == path
    assert blobs.get(inside) == FilePart(blobs.path(inside), digest=inside.digest)
    assert blobs.get(outside) == FilePart(path, external=True, digest=inside.digest)
    assert [one.name for one in (tmp_path / "store" / "blobs").rglob("*.*")] == [f"{inside.digest}.jpg"]


@pytest.mark.parametrize("name", ["a.b c", "a." + "x" * 17, "a.ä"])
def test_a_file_s_suffix_is_kept_only_if_any_system_can_have_it(tmp_path: Path, name: str) -> None:
    blobs = Store(tmp_path / "store").blobs
    (tmp_path / name).write_bytes(b"abc")
    assert blobs.put(FilePart(tmp_path / name)).suffix == ""


def test_a_users_file_that_is_not_as_it_was_listed_is_refused(tmp_path: Path) -> None:
    blobs = Store(tmp_path / "store").blobs
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    settle(path)
    listed = blobs.put(FilePart(path, external=True, digest=digest_from_bytes(b"abc")))
    with pytest.raises(ChangedFileError, match="changed during the run"):
        blobs.put(FilePart(path, external=True, digest=digest_from_bytes(b"xyz")))
    path.write_bytes(b"abcd")
    with pytest.raises(DamagedBlobError, match="is missing or changed"):
        blobs.get(listed)
    assert path.read_bytes() == b"abcd"  # it is the user's


def test_a_users_file_is_found_where_it_was_said_to_be(tmp_path: Path) -> None:
    blobs = Store(tmp_path / "store").blobs
    (tmp_path / "a").write_bytes(b"abc")
    ref = BlobRef(digest_from_bytes(b"abc"), 3, "", external=True)
    assert not blobs.exists(ref)
    blobs.place_external(ref.digest, tmp_path / "a")
    assert blobs.exists(ref)
    assert blobs.verified_place(ref) == tmp_path / "a"


@pytest.mark.parametrize("part", [{"a": 1}, np.arange(5), "file"])
def test_what_is_stored_already_is_marked_as_used_and_not_written_again(tmp_path: Path, part: Part | str) -> None:
    """A collection takes what has not been used for a while."""
    if isinstance(part, str):
        (tmp_path / "a.txt").write_bytes(b"abc")
        part = FilePart(tmp_path / "a.txt")
    ref = Store(tmp_path / "store").blobs.put(part)
    path = Store(tmp_path / "store").blobs.path(ref)
    os.utime(path, (1000, 1000))
    before = path.stat().st_ino
    assert Store(tmp_path / "store").blobs.put(part) == ref
    assert path.stat().st_ino == before
    assert path.stat().st_mtime > 1000


@pytest.mark.parametrize("part", [{"a": 1}, np.arange(5)])
def test_what_is_damaged_is_written_again(tmp_path: Path, part: Part) -> None:
    ref = Store(tmp_path).blobs.put(part)
    path = Store(tmp_path).blobs.path(ref)
    data = path.read_bytes()
    path.write_bytes(data[:-1] + b"?")
    assert Store(tmp_path).blobs.put(part) == ref
    assert path.read_bytes() == data


def test_bytes_are_checked_once_in_the_life_of_a_store(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ref = store.blobs.put({"a": 1})
    path = store.blobs.path(ref)
    assert store.blobs.verified_place(ref) == path
    data = path.read_bytes()
    path.write_bytes(data[::-1])
    assert store.blobs.verified_place(ref) == path
    with pytest.raises(DamagedBlobError, match="is damaged or missing"):
        Store(tmp_path).blobs.verified_place(ref)
    assert not path.exists()
    path.write_bytes(data[::-1])
    error = store.blobs.discard(ref, "is of no use")
    assert isinstance(error, DamagedBlobError)
    assert str(error) == f"{path} is of no use; the same command computes it again"
    path.write_bytes(data[::-1])
    with pytest.raises(DamagedBlobError, match="is damaged or missing"):
        store.blobs.verified_place(ref)


def test_a_blob_that_was_collected_since_it_was_verified_is_damage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for part in ({"a": 1}, np.arange(3)):
        ref = store.blobs.put(part)
        store.blobs.verified_place(ref)
        store.blobs.path(ref).unlink()
        with pytest.raises(DamagedBlobError, match="is gone; the same command"):
            store.blobs.get(ref)


def test_arrays_that_are_no_block_of_memory_are_stored_as_one(tmp_path: Path) -> None:
    blobs = Store(tmp_path).blobs
    array = np.arange(24).reshape(4, 6)
    for view in (array[::2, 1::2], array.T, array[:, :0], np.float32(3)):
        ref = blobs.put(np.asarray(view))
        assert ref.size_bytes == blobs.path(ref).stat().st_size
        np.testing.assert_array_equal(np.load(blobs.path(ref)), view)
        np.testing.assert_array_equal(blobs.get(ref), view)


@pytest.mark.parametrize("length", [1, -8, 8])
def test_an_array_with_fewer_or_more_bytes_than_it_says_is_damage(tmp_path: Path, length: int) -> None:
    blobs = Store(tmp_path).blobs
    data = blobs.path(blobs.put(np.arange(3))).read_bytes()
    data = data + bytes(length) if length > 0 else data[:length]
    ref = BlobRef(digest_from_bytes(data), len(data), ".npy")
    blobs.path(ref).parent.mkdir(exist_ok=True)
    blobs.path(ref).write_bytes(data)
    with pytest.raises(DamagedBlobError, match=r"that pano_mvs does not write \([0-9]+ bytes for an array of"):
        blobs.get(ref)


def test_a_small_array_of_a_later_format_is_read(tmp_path: Path) -> None:
    blobs = Store(tmp_path).blobs
    path = tmp_path / "a.npy"
    with path.open("wb") as stream:
        npy.write_array(stream, np.arange(3), version=(2, 0))
    ref = blobs.put(FilePart(path))
    np.testing.assert_array_equal(blobs.get(ref), np.arange(3))


def test_json_that_is_no_object_is_damage(tmp_path: Path) -> None:
    blobs = Store(tmp_path).blobs
    path = tmp_path / "a.json"
    path.write_bytes(b"[1]")
    with pytest.raises(DamagedBlobError, match="not an object"):
        blobs.get(blobs.put(FilePart(path)))


@pytest.mark.parametrize("text", ['{"layout": true}', '{"layout": 1}', '{"layout": "2"}', "[2]", "{}"])
def test_a_cache_of_an_unknown_layout_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "layout.json").write_text(text)
    with pytest.raises(UsageError, match=r"has layout .*, but this version uses 3\. Choose another cache with --cache"):
        Store(tmp_path)


def test_a_cache_whose_layout_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "layout.json").write_text("{")
    with pytest.raises(UsageError, match="so that the layout of the cache is unknown"):
        Store(tmp_path)
    (tmp_path / "layout.json").unlink()
    (tmp_path / "layout.json").mkdir()
    with pytest.raises(UsageError, match=r"cannot be read .*Check its permissions"):
        Store(tmp_path)


@pytest.mark.parametrize(
    ("number", "error", "said"),
    [
        (errno.EROFS, UsageError, "cannot be written .*Choose another"),
        (errno.ENOSPC, StoreError, "x: no space"),
    ],
)
def test_a_cache_that_cannot_be_made_is_refused_unless_it_is_only_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, error: type[Exception], said: str
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise StoreError("x: no space") from OSError(number, "no")

    monkeypatch.setattr(store_module, "write_text", fails)
    with pytest.raises(error, match=said):
        Store(tmp_path)
    assert Store(tmp_path, for_reading=True).find(KEY) is None


def test_a_cache_in_place_of_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UsageError, match="cannot be read"):
        Store(tmp_path / "file", for_reading=True)


def test_a_mark_that_is_a_link_stays_as_it_is(tmp_path: Path) -> None:
    Store(tmp_path / "store")
    mark = tmp_path / "store" / CACHE_MARK
    mark.unlink()
    mark.symlink_to(tmp_path / "elsewhere")
    Store(tmp_path / "store")
    assert not (tmp_path / "elsewhere").exists()


def test_records_and_blobs_behind_links_are_neither_written_nor_removed(tmp_path: Path) -> None:
    store, outside = Store(tmp_path / "store"), tmp_path / "outside"
    record = record_of(store)
    store.put(record)
    for path in (store.record_path(KEY), store.blobs.path(record.output.parts["array"])):
        path.parent.rename(outside / path.parent.name if outside.is_dir() else outside)
        path.parent.symlink_to(outside)
        assert path.is_file()
        before = path.read_bytes()
        with pytest.raises(StoreError, match="is a link, but caches have no links"):
            store.put(record) if path.suffix == ".json" else Store(tmp_path / "store").blobs.put(np.arange(3))
        if path.suffix == ".json":
            store.drop(KEY)
        else:
            store.blobs.discard(record.output.parts["array"], "is of no use")
        assert path.read_bytes() == before
        path.parent.unlink()
        outside.rename(path.parent)


def test_a_digest_that_was_remembered_of_a_users_file_goes_with_what_turned_out_wrong(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    body = json.dumps({str(path.resolve()): [*(StatCache.state(path) or ()), "0" * 32]})
    Store(tmp_path / "store")
    (tmp_path / "store" / "stat-cache.json").write_text(f"{digest_from_bytes(body.encode())}\n{body}")
    blobs = Store(tmp_path / "store").blobs
    ref = BlobRef(blobs.register_external(path), 3, "", external=True)
    assert ref.digest == "0" * 32
    blobs.discard(ref, "is of no use")
    assert path.read_bytes() == b"abc"
    assert blobs.register_external(path) == digest_from_bytes(b"abc")


def test_a_blob_that_is_not_there_is_damage(tmp_path: Path) -> None:
    blobs = Store(tmp_path).blobs
    for ref in (BlobRef(KEY, 3, ".npy"), BlobRef(KEY, 3, ".json")):
        with pytest.raises(DamagedBlobError, match="is damaged or missing"):
            blobs.verified_place(ref)


@pytest.mark.parametrize("shape", [(1,) * 70, (0, -1), (-1, -1)])
def test_an_array_of_a_shape_that_there_cannot_be_is_damage(tmp_path: Path, shape: tuple[int, ...]) -> None:
    blobs = Store(tmp_path).blobs
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    data = npy.magic(1, 0) + len(header).to_bytes(2, "little") + header + bytes(0 if 0 in shape else 1)
    ref = BlobRef(digest_from_bytes(data), len(data), ".npy")
    blobs.path(ref).parent.mkdir(exist_ok=True, parents=True)
    blobs.path(ref).write_bytes(data)
    with pytest.raises(DamagedBlobError, match="has content that pano_mvs does not write"):
        blobs.get(ref)


def test_a_stage_that_changes_the_folder_still_finds_its_scratch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with Store(Path("cache")).scratch() as scratch:
        monkeypatch.chdir("/")
        (scratch / "a.txt").touch()
        monkeypatch.chdir(tmp_path)
    assert not scratch.exists()


@pytest.mark.parametrize(("days", "goes"), [(6.9, False), (7.1, True)])
def test_what_has_another_name_goes_from_the_scratch_folder_after_seven_days(
    tmp_path: Path, days: float, goes: bool
) -> None:
    with Store(tmp_path).scratch() as young:
        old = young.parent / "old"
    old.mkdir()
    then = time.time() - days * 24 * 3600
    os.utime(old, (then, then))
    Store(tmp_path)
    assert old.exists() is not goes


def test_a_store_has_the_settings_that_it_was_opened_with(tmp_path: Path) -> None:
    plain, other = Store(tmp_path), Store(tmp_path, durable=True, min_free_bytes=5)
    assert MIN_FREE_BYTES == 200_000_000  # as docs/running.md says
    assert (plain.durable, plain.min_free_bytes, plain.blobs.durable) == (False, MIN_FREE_BYTES, False)
    assert (other.durable, other.min_free_bytes, other.blobs.durable) == (True, 5, True)
    greedy = Store(tmp_path, min_free_bytes=1 << 62)
    with pytest.raises(StoreError, match="MB are free on the disk of the cache"), greedy.scratch():
        pass
    with other.scratch():
        pass
    assert "is full" in str(plain.cannot_write(OSError(errno.ENOSPC, "no")))
    assert "cannot be written: no" in str(plain.cannot_write(OSError(errno.EROFS, "no")))


def test_with_durable_every_blob_and_record_is_flushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: list[int] = []
    monkeypatch.setattr(os, "fsync", flushed.append)
    store = Store(tmp_path / "plain")
    store.put(record_of(store))
    assert flushed == []
    durable = Store(tmp_path / "durable", durable=True)
    parts: tuple[Part, ...] = {"a": 1}, np.arange(3)
    for number, part in enumerate(parts, 1):
        durable.blobs.put(part)
        assert len(flushed) >= number
    before = len(flushed)
    durable.put(record_of(store))
    assert len(flushed) > before


@pytest.mark.skipif(os.name != "posix", reason="whether a process has ended is not known")
def test_what_a_process_that_has_ended_left_half_written_goes_at_once(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    Store(tmp_path)
    folder = tmp_path / "tmp"
    folder.mkdir(exist_ok=True)
    left = folder / f".tmp-{process_place()}-{ended.pid}-x"
    own = folder / f".tmp-{process_place()}-{os.getpid()}-x"
    left.mkdir()
    own.mkdir()
    (left / "half").write_bytes(b"x")
    Store(tmp_path)
    assert [path.name for path in folder.iterdir()] == [own.name]


def test_cache_keeps_to_its_layout(toy: Toy) -> None:
    root = toy.folder / "cache"
    assert toy.run().exit_code == 0
    assert {len(path.name) for name in ("records", "blobs") for path in (root / name).iterdir()} == {3}
    assert toy.run().computed == 0
    store = Store(root)
    damage = verify(store)
    assert damage.records == len(list((root / "records").rglob("*.json")))
    assert not damage.foreign
    found = collect(store, unused_s=-1, forget_after_s=-1)
    assert len(found.records) == damage.records
    assert len(found.blobs) == damage.blobs
