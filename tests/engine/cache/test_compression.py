"""Values of a cache that are compressed in packs: byte for byte what was stored, and damage is noticed."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.engine.cache import compression, dropping, maintenance, packs
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError, PackedRefs
from pano_mvs.engine.cache.compression import Shuffle, compress, decompress, decompressed_chunks, shuffle_of_file
from pano_mvs.engine.cache.maintenance import collect, pack, usage_of, verify
from pano_mvs.engine.cache.packs import Packed
from pano_mvs.engine.cache.store import LAYOUT_VERSION, ItemRef, Store, UnitRecord
from pano_mvs.scene import FilePart

RANGES = (np.round(64 * (1 + np.hypot(*np.mgrid[:300, :400] / 50))) / 64).astype(np.float32)


@pytest.fixture(autouse=True)
def pack_few_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1)


def place_of(store: Store, ref: BlobRef) -> Packed:
    place = store.blobs.place(ref)
    assert isinstance(place, Packed)
    return place


def read(store: Store, ref: BlobRef) -> NDArray[np.generic]:
    value = store.blobs.get(ref)
    assert isinstance(value, np.ndarray)
    return value


SHUFFLES = st.integers(1, 64).flatmap(
    lambda stride: st.builds(Shuffle, st.just(stride), st.integers(0, (1 << stride) - 1))
)


@given(st.binary(max_size=300), SHUFFLES, st.integers(1, 200), st.integers(1, 40))
def test_what_is_decompressed_is_what_was_compressed(data: bytes, shuffle: Shuffle, repeats: int, chunk: int) -> None:
    value, out = data * repeats, io.BytesIO(b"head")
    out.seek(4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compression, "_CHUNK_BYTES", chunk * 97)
        patch.setattr(compression, "_PAYS_BELOW", 10**9)
        stored = compress(io.BytesIO(value), len(value), out, shuffle=shuffle)
        assert out.getvalue()[:4] == b"head"
        assert len(out.getvalue()) == out.tell() == stored + 4 if value else True
        out.seek(4)
        if value:
            assert decompress(out, stored, len(value)).tobytes() == value


@given(st.binary(min_size=1, max_size=60), st.integers(0, 10**6))
def test_damage_is_an_error_or_other_bytes_but_never_a_crash(junk: bytes, place: int) -> None:
    out = io.BytesIO()
    stored = compress(io.BytesIO(bytes(5000)), 5000, out, shuffle=Shuffle(4))
    data = bytearray(out.getvalue())
    begin = place % stored
    data[begin : begin + len(junk)] = junk[: stored - begin]
    try:
        found = decompress(io.BytesIO(bytes(data)), stored, 5000)
    except ValueError:
        return
    assert found.shape == (5000,)


def test_a_size_in_a_damaged_chunk_reserves_no_memory() -> None:
    out = io.BytesIO()
    stored = compress(io.BytesIO(bytes(5000)), 5000, out, shuffle=Shuffle())
    data = bytearray(out.getvalue())
    data[14:22] = struct.pack("<Q", 1 << 60)
    with pytest.raises(ValueError, match="damaged beginning"):
        list(decompressed_chunks(io.BytesIO(bytes(data)), stored))
    data[14:22] = struct.pack("<Q", 4999)
    with pytest.raises(ValueError, match="wrong size"):
        list(decompressed_chunks(io.BytesIO(bytes(data)), stored))


def test_differences_are_stored_of_the_bytes_of_which_they_are_smaller(tmp_path: Path) -> None:
    """Neighbours have almost equal exponents, random last bits, and colours that change slowly."""
    rng = np.random.default_rng(3)
    ranges = (5 + np.arange(50_000) / 3000 + rng.normal(0, 1e-3, 50_000)).astype(np.float32)
    few = rng.integers(0, 3, 200_000).astype(np.uint8)
    ramp = (128 + 100 * np.sin(np.arange(100_000) / 900)).astype(np.uint8)
    store = Store(tmp_path)
    for array, expected in ((ranges, 0b0110), (few, 0), (ramp, 0b1)):
        ref = store.blobs.put(array)
        pack(store)
        place = place_of(store, ref)
        with place.pack.open("rb") as stream:
            stream.seek(place.offset + 5)
            assert Shuffle.from_bytes(stream.read(9)) == Shuffle(array.itemsize, expected)
        np.testing.assert_array_equal(read(Store(tmp_path), ref), array)


def test_what_does_not_pay_leaves_the_file_as_it_was() -> None:
    noise = np.random.default_rng(0).bytes(100_000)
    out = io.BytesIO(b"before")
    out.seek(6)
    assert compress(io.BytesIO(noise), len(noise), out, shuffle=Shuffle(4)) == 0
    assert (out.getvalue(), out.tell()) == (b"before", 6)


def test_a_value_that_was_cut_is_not_stored() -> None:
    with pytest.raises(EOFError, match="shorter"):
        compress(io.BytesIO(bytes(10)), 11, io.BytesIO(), shuffle=Shuffle())


@pytest.mark.parametrize("stride", [15, 27])
def test_the_size_of_the_elements_of_a_file_is_found(stride: int) -> None:
    rng = np.random.default_rng(stride)
    rows = rng.integers(0, 256, (9000, stride), np.uint8)
    numbers = rng.normal(5, 0.01, (9000, stride // 4)).astype(np.float32)
    rows[:, : 4 * (stride // 4)] = numbers.view(np.uint8)
    data = b"a header\n" + rows.tobytes()
    found = shuffle_of_file(io.BytesIO(data), len(data))
    assert found is not None
    assert found.stride == stride
    noise = rng.bytes(300_000)
    assert shuffle_of_file(io.BytesIO(noise), len(noise)) is None


ARRAYS: dict[str, NDArray[np.generic]] = {
    "ranges": RANGES,
    "normals": np.stack([RANGES] * 3, axis=-1).astype(np.float16),
    "columns": np.asfortranarray(RANGES.astype(np.float64)),
    "mask": RANGES > 2,
    "bytes": (RANGES * 20).astype(np.uint8),
    "invalid": np.where(RANGES > 4, np.float32(np.nan), RANGES),
    "fields": np.zeros(30_000, np.dtype([("a", "<f4"), ("b", "u1")])),
    "empty": np.zeros((0, 3)),
    "scalar": np.ones(()),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_are_read_as_they_were_stored(tmp_path: Path, name: str) -> None:
    array, store = ARRAYS[name], Store(tmp_path)
    ref = store.blobs.put(array)
    before = np.array(read(store, ref))
    assert pack(store) == 1
    for opened in (store, Store(tmp_path)):
        back = read(opened, ref)
        assert (back.dtype, back.shape, back.tobytes()) == (before.dtype, before.shape, before.tobytes())
        assert not back.flags.writeable
        assert back.flags.aligned
        assert opened.blobs.put(array) == ref, "it is not stored again"
    assert verify(store).removed == []
    if array.nbytes > 10_000:
        assert place_of(store, ref).is_compressed
        assert place_of(store, ref).size_bytes < 0.5 * array.nbytes
        assert not store.blobs.is_mapped(ref)


def test_noise_and_large_arrays_stay_mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packs, "MAX_COMPRESSED_BYTES", RANGES.nbytes)
    store = Store(tmp_path)
    noise = np.random.default_rng(1).integers(0, 256, 300_000, np.uint8)
    refs = [store.blobs.put(noise), store.blobs.put(RANGES)]
    pack(store)
    for ref, array in zip(refs, (noise, RANGES), strict=True):
        assert not place_of(store, ref).is_compressed
        assert store.blobs.is_mapped(ref)
        assert isinstance(read(store, ref), np.memmap)
        np.testing.assert_array_equal(read(store, ref), array)


def test_damage_of_a_compressed_array_is_noticed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    refs = [store.blobs.put(RANGES), store.blobs.put(RANGES[::-1])]
    pack(store)
    places = [place_of(store, ref) for ref in refs]
    data = bytearray(places[0].pack.read_bytes())
    data[places[0].offset + 200] ^= 1
    places[0].pack.write_bytes(bytes(data))
    with pytest.raises(DamagedBlobError, match="is damaged"):
        Store(tmp_path).blobs.get(refs[0])
    assert not store.blobs.exists(refs[0])
    assert store.blobs.exists(refs[1])
    data[places[1].offset + 200] ^= 1
    places[1].pack.write_bytes(bytes(data))
    assert len(verify(Store(tmp_path)).removed) == 1
    assert store.blobs.put(RANGES) == refs[0]
    np.testing.assert_array_equal(read(store, refs[0]), RANGES)


def a_file(folder: Path) -> FilePart:
    """Return a file of points."""
    path = folder / "made.ply"
    points = np.zeros(9000, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    points["xyz"] = np.arange(9000)[:, None] / 7
    path.write_bytes(b"ply\n" + points.tobytes())
    return FilePart(path)


def test_files_are_compressed_and_copied_as_they_were(tmp_path: Path) -> None:
    store, made = Store(tmp_path / "cache"), a_file(tmp_path)
    ref = store.blobs.put(made)
    assert pack(store) == 1
    assert place_of(store, ref).size_bytes < 0.5 * ref.size_bytes
    assert not list((tmp_path / "cache" / "blobs").rglob("*.ply"))
    for opened in (store, Store(store.root)):
        opened.blobs.copy(ref, tmp_path / "copy.ply")
        assert (tmp_path / "copy.ply").read_bytes() == made.path.read_bytes()
        assert opened.blobs.put(made) == ref
    assert store.blobs.stored_bytes(ref) == place_of(store, ref).size_bytes
    found = verify(store)
    assert (found.blobs, found.removed, found.foreign) == (1, [], [])


def test_a_file_that_a_stage_reads_is_a_file_again_until_the_next_pack(tmp_path: Path) -> None:
    store, made = Store(tmp_path / "cache"), a_file(tmp_path)
    ref = store.blobs.put(made)
    pack(store)
    part = Store(store.root).blobs.get(ref)
    assert isinstance(part, FilePart)
    assert part.path.suffix == ".ply"
    assert part.read_bytes() == made.path.read_bytes()
    assert pack(store) == 1
    assert not part.path.exists()
    assert verify(store).blobs == 1, "it is in the packs once"


def test_images_stay_files(tmp_path: Path) -> None:
    store = Store(tmp_path / "cache")
    path = tmp_path / "a.jpg"
    path.write_bytes(np.random.default_rng(2).bytes(200_000))
    ref = store.blobs.put(FilePart(path))
    pack(store)
    assert isinstance(store.blobs.place(ref), Path)


def test_few_but_large_results_are_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 256)
    store = Store(tmp_path)
    store.blobs.put(RANGES)
    assert pack(store) == 0
    monkeypatch.setattr(maintenance, "_MIN_PACKED_BYTES", 100_000)
    assert pack(store) == 1


def test_compressed_values_survive_merging_and_garbage_collection(tmp_path: Path) -> None:
    store = Store(tmp_path)
    kept = []
    for number in range(4):
        kept.append(store.blobs.put(RANGES + number))
        pack(store)
    assert len(list((tmp_path / "packs").glob("*.pack"))) < 4
    for number, ref in enumerate(kept):
        np.testing.assert_array_equal(read(Store(tmp_path), ref), RANGES + number)
    assert len(collect(store, unused_s=0, delete=True).blobs) == 4
    assert not list((tmp_path / "packs").iterdir())


def test_usage_counts_what_is_on_the_disk(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert usage_of(store) == []
    ref = store.blobs.put(RANGES)
    assert store.blobs.stored_bytes(ref) == ref.size_bytes
    pack(store)
    assert store.blobs.stored_bytes(ref) < 0.7 * ref.size_bytes


def test_a_cache_of_the_layout_before_is_read_and_says_when_it_is_no_longer_that(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (tmp_path / "layout.json").write_text(json.dumps({"layout": 2}))
    ref = Store(tmp_path).blobs.put(RANGES)
    assert json.loads((tmp_path / "layout.json").read_text()) == {"layout": 2}
    pack(store)
    assert json.loads((tmp_path / "layout.json").read_text()) == {"layout": LAYOUT_VERSION}
    np.testing.assert_array_equal(read(Store(tmp_path), ref), RANGES)
    (tmp_path / "layout.json").write_text(json.dumps({"layout": LAYOUT_VERSION + 1}))
    with pytest.raises(UsageError, match="has layout"):
        Store(tmp_path)


def test_a_full_disk_loses_no_packed_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, file = Store(tmp_path / "cache"), tmp_path / "a.bin"
    file.write_bytes(bytes(200_000))
    ref = store.blobs.put(FilePart(file))
    assert pack(store)

    def full(*_: object, **__: object) -> None:
        raise StoreError("cannot be written. Free some space")

    with monkeypatch.context() as patch:
        patch.setattr(type(store.blobs), "_writing", full)
        with pytest.raises(StoreError, match="Free some space") as caught:
            store.blobs.get(ref)
    assert not isinstance(caught.value, DamagedBlobError)
    found = store.blobs.get(ref)
    assert isinstance(found, FilePart)
    assert found.path.read_bytes() == bytes(200_000)


def test_a_file_whose_pack_is_collected_while_it_is_read_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, file = Store(tmp_path / "cache"), tmp_path / "a.bin"
    file.write_bytes(bytes(200_000))
    ref = store.blobs.put(FilePart(file))
    assert pack(store)

    def collected(packed: Packed, _: object) -> None:
        store.blobs.packs.remove(packed.pack)
        raise FileNotFoundError(packed.pack)

    monkeypatch.setattr(Packed, "write_to", collected)
    with pytest.raises(DamagedBlobError, match="is gone"):
        store.blobs.get(ref)


def test_records_and_blobs_of_a_pack_that_was_deleted_by_hand(tmp_path: Path) -> None:
    """Regression: its index stayed, so that writing its record again did not end."""
    store = Store(tmp_path / "cache")
    part = store.blobs.put(RANGES)
    record = UnitRecord("ab" * 16, {}, ItemRef("K", "d" * 32, PackedRefs({"values": part})))
    store.put(record)
    assert pack(store)
    for path in store.blobs.packs.folder.glob("*.pack"):
        path.unlink()
    again = Store(tmp_path / "cache")
    again.put(record)
    assert again.packed_record(record.key) is not None
    dropping._delete(again, list(record.blobs()))


@pytest.mark.parametrize("is_array", [True, False])
def test_a_value_that_another_process_packs_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_array: bool
) -> None:
    store, file = Store(tmp_path / "cache"), tmp_path / "a.bin"
    file.write_bytes(bytes(200_000))
    ref = store.blobs.put(RANGES if is_array else FilePart(file))
    verified = store.blobs.verified_place

    def packed_before(ref: BlobRef) -> Path | Packed:
        monkeypatch.undo()
        monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1)
        assert pack(Store(tmp_path / "cache"))
        return verified(ref)

    monkeypatch.setattr(store.blobs, "verified_place", packed_before)
    found = store.blobs.get(ref)
    if isinstance(found, FilePart):
        assert found.path.read_bytes() == bytes(200_000)
    else:
        np.testing.assert_array_equal(found, RANGES)
