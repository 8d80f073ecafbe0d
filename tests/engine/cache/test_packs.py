"""Caches whose records and blobs are in packs, and caches with what is no file in the place of one.

Packed references to blobs are those that were packed.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.files import remove_whole
from pano_mvs.engine.cache import maintenance
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError, PackedRefs
from pano_mvs.engine.cache.maintenance import collect, pack, usage_of, verify
from pano_mvs.engine.cache.packs import Packed
from pano_mvs.engine.cache.store import ItemRef, Store
from tests.engine.conftest import Toy


@pytest.fixture(autouse=True)
def pack_few_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1)


def loose(root: Path) -> list[Path]:
    """Return the files that could be in packs."""
    found = [path for name in ("records", "blobs") for path in (root / name).rglob("*.*")]
    return sorted(path for path in found if path.suffix in (".json", ".npy"))


def files(root: Path, pattern: str) -> list[Path]:
    return sorted((root / "packs").glob(pattern))


def test_a_run_packs_its_results_and_the_next_one_finds_them(toy: Toy) -> None:
    assert toy.run().computed
    root = toy.folder / "cache"
    assert not loose(root)
    assert len(files(root, "*")) == 2
    remove_whole(toy.folder / "out")
    assert toy.run().computed == 0
    assert toy.run("scaled.by=7").exit_code == 0
    assert len(files(root, "*")) <= 4


def test_a_packed_cache_says_and_delivers_what_an_unpacked_one_does(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 10**9)
    toy.run()
    clean, store = toy.deliverables(), Store(toy.folder / "cache")
    before = verify(store)
    usage = [(entry.stage, entry.units, entry.size_bytes) for entry in usage_of(store)]
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1)
    assert pack(store) > before.records
    for opened in (store, Store(store.root)):
        after = verify(opened)
        assert (after.records, after.blobs, after.removed) == (before.records, before.blobs, [])
        assert [(entry.stage, entry.units, entry.size_bytes) for entry in usage_of(opened)] == usage
    remove_whole(toy.folder / "out")
    assert toy.run().computed == 0
    assert toy.deliverables() == clean


@pytest.mark.parametrize("count", [3, 100_000])
def test_values_that_are_moved_while_they_are_in_use_are_still_found(tmp_path: Path, count: int) -> None:
    reader = Store(tmp_path)
    array = np.arange(count, dtype=np.float64)
    refs = [reader.blobs.put(array), reader.blobs.put({"a": count})]
    for ref in refs:
        reader.blobs.verified_place(ref)
    assert pack(Store(tmp_path)) == 2
    assert not loose(tmp_path)
    for blobs in (reader.blobs, Store(tmp_path).blobs):
        back, meta = blobs.get(refs[0]), blobs.get(refs[1])
        assert isinstance(back, np.ndarray)
        assert isinstance(back, np.memmap) == blobs.is_mapped(refs[0])
        assert back.flags.aligned
        assert not back.flags.writeable
        np.testing.assert_array_equal(back, array)
        assert meta == {"a": count}
        assert blobs.put(array) == refs[0]
    assert not loose(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_damage_in_a_pack_is_noticed_and_computed_again(toy: Toy, seed: int) -> None:
    toy.run()
    clean, root, rng = toy.deliverables(), toy.folder / "cache", random.Random(seed)
    (path,) = files(root, "*.pack")
    data = bytearray(path.read_bytes())
    for place in rng.sample(range(len(data)), 40):
        data[place] ^= 1 << rng.randrange(8)
    path.write_bytes(data[: -rng.randrange(1, 2000)])
    if seed:
        assert verify(Store(root)).removed
        assert not verify(Store(root)).removed
    remove_whole(toy.folder / "out")
    result = toy.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert result.computed
    assert toy.deliverables() == clean
    verify(Store(root))  # removes what nobody had to read
    toy.run()
    after = verify(Store(root))
    assert not [*after.removed, *after.incomplete]


@pytest.mark.parametrize("damage", ["flip", "cut", "missing"])
def test_without_its_index_a_pack_is_computed_again(toy: Toy, damage: str) -> None:
    toy.run()
    clean, root = toy.deliverables(), toy.folder / "cache"
    (index,) = files(root, "*.index")
    data = index.read_bytes()
    index.write_bytes({"flip": data[:-1] + b"?", "cut": data[:-5], "missing": b""}[damage])
    if damage == "missing":
        index.unlink()
    removed = verify(Store(root)).removed
    assert removed == ([] if damage == "missing" else [str(index)])
    result = toy.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert result.computed
    assert toy.deliverables() == clean
    collect(Store(root), unused_s=0.0, delete=True)
    assert len(files(root, "*.pack")) == len(files(root, "*.index"))


def test_collection_rewrites_packs_without_what_is_not_needed(toy: Toy) -> None:
    toy.run("scaled.by=7")
    toy.run()
    root, clean = toy.folder / "cache", toy.deliverables()
    pack(Store(root))
    before = sum(path.stat().st_size for path in files(root, "*.pack"))
    assert not collect(Store(root), unused_s=3600.0, delete=True).records
    found = collect(Store(root), unused_s=0.0, delete=True)
    assert found.records
    assert sum(path.stat().st_size for path in files(root, "*.pack")) <= before - found.size_bytes / 2
    assert not collect(Store(root), unused_s=0.0, delete=True).records
    remove_whole(toy.folder / "out")
    assert toy.run().computed == 0
    assert toy.deliverables() == clean
    collect(Store(root), unused_s=0.0, forget_after_s=-1.0, delete=True)
    assert not [*files(root, "*"), *loose(root)]


def test_small_packs_are_merged(tmp_path: Path) -> None:
    store = Store(tmp_path)
    refs = []
    for number in range(12):
        refs += [store.blobs.put(np.arange(number, number + size)) for size in (1, 50)]
        pack(Store(tmp_path))
    assert len(files(tmp_path, "*.pack")) <= 4
    for ref in refs:
        assert len(store.blobs.get(ref)) in (1, 50)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_cache_is_packed_while_a_run_uses_it(toy: Toy) -> None:
    for number in range(6, 25):
        toy.number(f"{number}.txt", str(10 * number))
    toy.run()
    clean, root, ended = toy.deliverables(), toy.folder / "cache", threading.Event()
    remove_whole(root)
    problems: list[BaseException] = []

    def keep_packing() -> None:
        try:
            while not ended.is_set():
                pack(Store(root))
        except BaseException as error:
            problems.append(error)

    thread = threading.Thread(target=keep_packing)
    thread.start()
    result = toy.run()
    ended.set()
    thread.join()
    assert not problems
    assert [failure.trace or failure.cause for failure in result.failures] == []
    assert (result.exit_code, result.warnings) == (0, [])
    assert toy.deliverables() == clean
    assert not verify(Store(root)).removed


PLANTED: dict[str, Callable[[Path], None]] = {
    "fifo": os.mkfifo,
    "folder": lambda path: (path / "inside").mkdir(parents=True),
    "endless": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="Windows has no FIFOs")
@pytest.mark.parametrize("what", PLANTED)
@pytest.mark.parametrize("where", ["records", "blobs", "packs"])
def test_what_is_no_file_is_reported_and_computed_again(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, where: str, what: str
) -> None:
    """Reading a FIFO or /dev/zero never ended, and a folder stopped runs and `cache verify`."""
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1 if where == "packs" else 10**9)
    toy.run()
    clean, root = toy.deliverables(), toy.folder / "cache"
    paths = [path for path in (root / where).rglob("*.*") if path.is_file()]
    assert paths
    for path in paths:
        path.unlink()
        PLANTED[what](path)
    remove_whole(toy.folder / "out")
    result = toy.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert toy.deliverables() == clean
    assert result.computed
    if where == "records":
        assert any("is damaged; computing it again" in text for text in result.warnings)
    for path in [path for path in (root / where).rglob("*.*") if path.is_file()][:3]:
        path.unlink()
        PLANTED[what](path)
    damage = verify(Store(root))
    assert damage.removed or damage.foreign or damage.temporary
    assert toy.run().exit_code == 0
    assert toy.deliverables() == clean


@pytest.mark.skipif(os.name != "posix", reason="Windows has no FIFOs")
@pytest.mark.parametrize("name", ["stat-cache.json", "unit-times.json", "runs"])
def test_a_fifo_in_place_of_a_list_of_the_cache_is_not_waited_for(toy: Toy, name: str) -> None:
    toy.run()
    root = toy.folder / "cache"
    paths = list((root / name).glob("*.json")) if name == "runs" else [root / name]
    for path in paths:
        path.unlink(missing_ok=True)
        os.mkfifo(path)
    assert toy.run().computed == 0


def test_a_damaged_value_in_a_pack_is_removed_from_its_index_alone(tmp_path: Path) -> None:
    store = Store(tmp_path)
    refs = [store.blobs.put({"a": number}) for number in range(4)]
    pack(store)
    (path,) = files(tmp_path, "*.pack")
    data = path.read_bytes()
    path.write_bytes(data.replace(b'{"a":2}', b'{"a":9}'))
    with pytest.raises(DamagedBlobError, match=r"\.pack:[0-9a-f]+\.json is damaged or missing"):
        Store(tmp_path).blobs.get(refs[2])
    assert [store.blobs.exists(ref) for ref in refs] == [True, True, False, True]
    assert path.read_bytes().count(b'{"a":') == 4


def test_a_pack_without_values_is_removed(tmp_path: Path) -> None:
    """Another process may have packed and removed all values meanwhile; or the only value is damaged."""
    store = Store(tmp_path)
    gone = tmp_path / "blobs" / "gone.json"
    value = Packed(store.blobs.packs.folder, 0, 7, "0" * 32, ".json")
    store.blobs.packs.add([(value, gone)])
    assert not files(tmp_path, "*")
    gone.parent.mkdir(exist_ok=True)
    gone.write_bytes(b'{"a":1}')
    store.blobs.packs.add([(value, gone)])
    assert len(files(tmp_path, "*")) == 2
    assert len(verify(store).removed) == 1
    assert not files(tmp_path, "*")


PACKER = """
import sys
from pathlib import Path
from pano_mvs.engine.cache import maintenance
from pano_mvs.engine.cache.store import Store

maintenance._MIN_PACKED_FILES = 1
store, number = Store(Path(sys.argv[1])), int(sys.argv[2])
while True:
    for number in range(number + 1, number + 30):
        store.blobs.put({"a": number})
        print(number, flush=True)
    maintenance.pack(store)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="Windows has no SIGKILL")
def test_a_process_that_is_killed_while_it_packs_loses_nothing(tmp_path: Path) -> None:
    """Two at a time pack one cache; each is killed at a random moment, and others go on."""
    rng, stored = random.Random(7), set[int]()
    for turn in range(3):
        running = [
            subprocess.Popen(
                [sys.executable, "-c", PACKER, str(tmp_path), str(100_000 * (2 * turn + which))],
                stdout=subprocess.PIPE,
                text=True,
            )
            for which in range(2)
        ]
        for process in running:
            assert process.stdout is not None
            stored |= {int(process.stdout.readline()) for _ in range(rng.randrange(40, 400))}
            process.kill()
            stored |= {int(line) for line in process.stdout.read().splitlines()}
            process.stdout.close()
            process.wait()
    store = Store(tmp_path)
    for number in stored:
        body = json.dumps({"a": number}, separators=(",", ":")).encode()
        assert store.blobs.get(BlobRef(digest_from_bytes(body), len(body), ".json")) == {"a": number}
    assert not verify(store).removed
    collect(store, unused_s=0.0, delete=True)
    assert not [*files(tmp_path, "*"), *loose(tmp_path)]


PARTS = {
    "meta": BlobRef("0" * 32, 0, ".json"),
    "image": BlobRef("f0" * 16, 123, ".jpg", external=True),
    "array": BlobRef("0123456789abcdef" * 2, (1 << 50) - 1, ".npy"),
    "0": BlobRef("1" * 32, 255, ""),
}


@pytest.mark.parametrize("names", [[], ["array"], list(PARTS), list(reversed(PARTS))])
def test_packed_references_equal_a_dict_of_the_same(names: list[str]) -> None:
    parts = {name: PARTS[name] for name in names}
    packed = PackedRefs(parts)
    assert list(packed.items()) == list(parts.items())
    assert packed == parts
    assert parts == packed
    assert packed == PackedRefs(parts)
    assert repr(packed) == repr(parts)


def test_packed_references_differ_in_any_field() -> None:
    packed = PackedRefs(PARTS)
    for name, ref in PARTS.items():
        others = [
            BlobRef("2" * 32, ref.size_bytes, ref.suffix, ref.external),
            BlobRef(ref.digest, ref.size_bytes ^ 1, ref.suffix, ref.external),
            BlobRef(ref.digest, ref.size_bytes, ".other", ref.external),
            BlobRef(ref.digest, ref.size_bytes, ref.suffix, not ref.external),
        ]
        assert all(packed != PackedRefs(PARTS | {name: other}) for other in others)
    with pytest.raises(KeyError, match="nothing"):
        packed["nothing"]


def test_a_reference_has_what_it_was_made_of() -> None:
    ref = ItemRef("Kind", "0f" * 16, PARTS)
    assert (ref.kind, ref.digest, dict(ref.parts)) == ("Kind", "0f" * 16, PARTS)
    assert ref == ItemRef.from_json(ref.to_json())
    assert ref == ItemRef("Kind", "0f" * 16, dict(reversed(PARTS.items())))
    others = ItemRef("Other", "0f" * 16, PARTS), ItemRef("Kind", "00" * 16, PARTS), ItemRef("Kind", "0f" * 16, {})
    assert all(ref != other for other in (*others, "Kind"))
    assert repr(ref).startswith("ItemRef(kind='Kind', digest='0f0f")
    for wrong in ("", "0f", "0F" * 16, "0f" * 17, "none" * 8):
        with pytest.raises(ValueError, match="not a digest"):
            ItemRef("Kind", wrong, PARTS)
