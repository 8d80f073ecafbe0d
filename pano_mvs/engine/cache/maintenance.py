"""Maintenance of a cache: its contents by stage, verification, packing, and garbage collection.

Packing moves records, arrays and JSON values from files of their own into packs, so that large captures take few files,
and compresses arrays there, and files where that pays. Values are found in the packs before their files are removed, so
that runs may use the cache meanwhile.

Garbage collection keeps what the remembered runs and pins name, and deletes everything else that is older than a given
age. It takes no lock: what a run has just computed is too recent to be deleted, and a run computes again what is
missing.
"""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from pano_mvs.core.digest import DIGEST_BYTES, IS_DIGEST, digest_from_file
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import make_room, read_regular, whose_temporary
from pano_mvs.core.paths import is_file, is_link
from pano_mvs.engine.cache.blobs import FOLDER_DIGITS, SUFFIX, element_bytes
from pano_mvs.engine.cache.compression import Shuffle, shuffle_of_array, shuffle_of_file
from pano_mvs.engine.cache.latest_runs import RunEntry, delete
from pano_mvs.engine.cache.packs import ARRAY, FILE, JSON, RECORD, Packed, is_compressible
from pano_mvs.engine.cache.store import Store, UnitRecord, record_from_bytes

_BLOB_NAME = re.compile(rf"({IS_DIGEST.pattern}){SUFFIX.pattern}")
_RECORD_NAME = re.compile(rf"({IS_DIGEST.pattern})\.json")
_MIN_PACKED_FILES = 256  # fewer files stay as they are, as other programs can read them, …
_MIN_FILE_BYTES = 1 << 16  # of a file to be compressed
_MIN_PACKED_BYTES = 8_000_000  # … unless they are larger than this


@dataclass(frozen=True, slots=True)
class StageUsage:
    """The results of one stage in a cache."""

    stage: str  # name of the stage in the registry
    units: int
    size_bytes: int  # size of their blobs in the cache; a blob that several units share counts once
    seconds: float


@dataclass(slots=True)
class Verification:
    """What a verification found."""

    records: int = 0
    blobs: int = 0
    # damaged files, which were removed; the next run computes them again
    removed: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)  # records with missing blobs, which runs ignore
    foreign: list[str] = field(default_factory=list)
    # temporary files, each with the process that it belongs to, and unfinished packs
    temporary: list[str] = field(default_factory=list)


@dataclass(slots=True)
class GarbageCollection:
    """What a garbage collection deletes, or would delete."""

    runs: list[RunEntry] = field(default_factory=list)  # remembered runs that are too old
    records: list[Path | Packed] = field(default_factory=list)
    blobs: list[Path | Packed] = field(default_factory=list)  # blobs, and packs that were not finished
    size_bytes: int = 0
    kept_bytes: int = 0


@dataclass(frozen=True, slots=True)
class _Value:
    """A record or a blob: where it is, its key or digest, its size, and when it was last used."""

    place: Path | Packed
    digest: str
    size_bytes: int
    used_s: float

    @property
    def name(self) -> str:
        return self.place.name if isinstance(self.place, Packed) else str(self.place)

    @property
    def file_name(self) -> str:
        return f"{self.digest}{self.place.kind if isinstance(self.place, Packed) else self.place.suffix}"


def usage_of(store: Store) -> list[StageUsage]:
    """Return the results of each stage in a cache, the largest first."""
    seen: set[str] = set()
    totals: dict[str, list[float]] = {}
    for _, record in _intact_records(store):
        total = totals.setdefault(str(record.identity.get("stage", "unknown")), [0, 0, 0.0])
        total[0] += 1
        total[2] += record.seconds
        for ref in record.own_blobs():
            if ref.digest not in seen:
                seen.add(ref.digest)
                total[1] += store.blobs.stored_bytes(ref)
    found = [StageUsage(name, int(units), int(size), seconds) for name, (units, size, seconds) in totals.items()]
    return sorted(found, key=lambda usage: (-usage.size_bytes, usage.stage))


def size_on_disk(store: Store) -> int:
    """Return the size of all files of a cache."""
    stats = (_stat(file.path) for file in _files(store.root))
    return sum(stat.st_size for stat in stats if stat is not None)


def verify(store: Store) -> Verification:
    """Check every record and every blob against its digest, and remove damaged ones; foreign files are kept.

    Runs may use the cache at the same time.

    Raises:
        StoreError: if a file cannot be read or removed.
    """
    found = Verification()
    intact: set[str] = set()
    for folder, pattern in (("blobs", _BLOB_NAME), ("records", _RECORD_NAME)):
        for file in _files(store.root / folder):
            if _own_name(file, pattern):
                continue
            is_special = not is_link(Path(file.path)) and not is_file(Path(file.path))
            if pattern.fullmatch(file.name) and is_special:
                make_room(Path(file.path))
                found.removed.append(file.path)
            else:
                found.foreign.append(file.path)
    for index in store.blobs.packs.damaged_indexes():
        store.blobs.packs.remove(index.with_suffix(".pack"))
        found.removed.append(str(index))
    for value in _blobs(store):
        digest = _digest(value.place)
        if digest == value.digest:
            intact.add(value.file_name)
            found.blobs += 1
        elif digest:
            _remove_damaged(store, value, found)
    for value in _records(store):
        data = _read(value.place)
        if data is not None:
            _verify_record(store, value, data, found=found, intact=intact)
    for path in store.blobs.packs.without_index():
        found.temporary.append(f"{path} (a pack that was not finished; collection removes it)")
    for entry in _sorted(store.blobs.temporary):
        found.temporary.append(f"{entry.path} ({whose_temporary(Path(entry.path))})")
    return found


def _remove_damaged(store: Store, value: _Value, found: Verification) -> None:
    if isinstance(value.place, Packed):
        store.blobs.packs.forget([value.place])
    else:
        delete(value.place)
    found.removed.append(value.name)


def _verify_record(store: Store, value: _Value, data: bytes, *, found: Verification, intact: set[str]) -> None:
    """Check a record and its blobs, and enter it into what was found."""
    record = record_from_bytes(data)
    if record is None or record.key != value.digest:
        _remove_damaged(store, value, found)
        return
    # A running workflow may have written other blobs after the blobs were checked.
    blobs = (ref for ref in record.own_blobs() if f"{ref.digest}{ref.suffix}" not in intact)
    if all(_digest(store.blobs.place(ref)) == ref.digest for ref in blobs):
        found.records += 1
    else:
        found.incomplete.append(value.name)


def pack(store: Store) -> int:
    """Move values from files of their own into packs, and compress them; return how many files were removed.

    Few and small files stay as they are, and so do files that cannot be compressed. Runs may use the cache at the same
    time.

    Raises:
        StoreError: if a file cannot be read, written or removed.
    """
    packs = store.blobs.packs
    found = [(value, kind, value.place) for value, kind in _packable(store) if isinstance(value.place, Path)]
    if len(found) < _MIN_PACKED_FILES and sum(value.size_bytes for value, _, _ in found) < _MIN_PACKED_BYTES:
        return 0
    loose = [
        (Packed(packs.folder, 0, value.size_bytes, value.digest, kind, value.used_s, shuffle=shuffle), path)
        for value, kind, path in found
        if (shuffle := _shuffle_of(value, kind, path)) is not None
    ]
    if not loose:
        return 0
    store.mark_layout()
    small = _merged(packs.times(), sum(value.size_bytes for value, _ in loose))
    new = (item for item in loose if item[0].kind != FILE or packs.find(item[0].digest) is None)  # it was unpacked
    packs.add(chain(list(new), ((value, None) for value in packs.each() if value.pack in small)))
    for value, path in loose:
        if packs.find(value.digest) is not None:
            delete(path)
    for path in small:
        packs.remove(path)
    return len(loose)


def _merged(packs: Iterable[Path], size_bytes: int) -> set[Path]:
    """Return the packs to merge with a new one, so that each is more than twice as large as the next smaller one.

    Their number then grows with the logarithm of what is packed, and each value is copied as often.
    """
    chosen: set[Path] = set()
    for size, path in sorted((found.st_size, path) for path in packs if (found := _stat(path)) is not None):
        if size > 2 * size_bytes:
            break
        chosen.add(path)
        size_bytes += size
    return chosen


def _packable(store: Store) -> Iterator[tuple[_Value, str]]:
    """Yield the values that may be in packs, each with its kind there."""
    for value in _records(store):
        yield value, RECORD
    for value in _blobs(store):
        if isinstance(value.place, Path) and value.place.suffix in (ARRAY, JSON):
            yield value, value.place.suffix
        elif isinstance(value.place, Path) and value.size_bytes >= _MIN_FILE_BYTES:
            yield value, FILE


def _shuffle_of(value: _Value, kind: str, path: Path) -> Shuffle | None:
    """Return how a value is compressed, if it is at all; None for a file that stays as it is."""
    with suppress(OSError):  # another process may have deleted it
        if kind == FILE:
            with path.open("rb") as stream:
                return shuffle_of_file(stream, value.size_bytes)
        if kind == ARRAY and is_compressible(kind, value.size_bytes):
            with path.open("rb") as stream:
                return shuffle_of_array(stream, value.size_bytes, stride=element_bytes(stream))
    return Shuffle()


def collect(
    store: Store, *, unused_s: float, forget_after_s: float | None = None, delete: bool = False
) -> GarbageCollection:
    """Find, and optionally delete, what no remembered run and no pin names.

    Args:
        unused_s: keep what was computed within this time; files with times in the future count by their distance from
            now, as those of a clock that is wrong.
        forget_after_s: forget runs that ended longer ago than this; None forgets none. Pins are kept.

    Raises:
        StoreError: if a remembered run is damaged, so that it is not known what it protects, or if a file cannot be
            read or deleted.
    """
    found = GarbageCollection()
    now = time.time()
    kept_keys: set[bytes] = set()
    for entry in store.runs.each():
        if not entry.pinned and forget_after_s is not None and entry.age_s() > forget_after_s:
            found.runs.append(entry)
        else:
            kept_keys.update(_packed(key) for units in entry.keys.values() for key in units.values())
    kept_blobs: set[bytes] = set()
    for value, record in _intact_records(store):
        if _packed(record.key) not in kept_keys and _is_unused(value.used_s, now, unused_s):
            found.records.append(value.place)
            found.size_bytes += value.size_bytes
        else:
            kept_blobs.update(_packed(ref.digest) for ref in record.lasting_blobs())
    unfinished = (
        _Value(path, "", stat.st_size, stat.st_mtime)
        for path in store.blobs.packs.without_index()
        if (stat := _stat(path)) is not None
    )
    for value in chain(_blobs(store), unfinished):
        if _packed(value.digest) in kept_blobs or not _is_unused(value.used_s, now, unused_s):
            found.kept_bytes += value.size_bytes
        else:
            found.blobs.append(value.place)
            found.size_bytes += value.size_bytes
    if delete:
        _delete(store, found, now=now, unused_s=unused_s)
    return found


def _is_unused(used_s: float, now: float, unused_s: float) -> bool:
    """Return whether a time is long ago; one far in the future is the error of a clock."""
    return abs(now - used_s) >= unused_s


def _delete(store: Store, found: GarbageCollection, *, now: float, unused_s: float) -> None:
    """Delete records before the blobs that they name, so that no record is left without its blobs."""
    packs = store.blobs.packs
    for entry in found.runs:
        store.runs.forget(entry)
    for places in (found.records, found.blobs):
        times = packs.times()
        # A run may have used a value in the meantime.
        packs.forget(
            place
            for place in places
            if isinstance(place, Packed) and _is_unused(times.get(place.pack, now), now, unused_s)
        )
        for place in places:
            stat = _stat(place) if isinstance(place, Path) else None
            if stat is not None and _is_unused(stat.st_mtime, now, unused_s):
                delete(Path(str(place)))
    packs.rewrite({place.pack for place in (*found.records, *found.blobs) if isinstance(place, Packed)})


def _packed(digest: str) -> bytes:
    """Return the first half of a digest as bytes, to save memory; empty if the text is not a digest.

    Even among millions of digests no two begin alike. If two did, one file too many would be kept.
    """
    return bytes.fromhex(digest[:DIGEST_BYTES]) if IS_DIGEST.fullmatch(digest) else b""


def each_record(store: Store) -> Iterator[tuple[str, bytes]]:
    """Yield the key and the bytes of every record, whether or not it is intact."""
    for value in _records(store):
        yield value.digest, _read(value.place) or b""


def _records(store: Store) -> Iterator[_Value]:
    """Yield every record, whether or not it is intact."""
    yield from _of_files(store, "records", _RECORD_NAME)
    yield from (value for value, kind in _of_packs(store) if kind == RECORD)


def _blobs(store: Store) -> Iterator[_Value]:
    """Yield every blob, whether or not it is intact."""
    yield from _of_files(store, "blobs", _BLOB_NAME)
    yield from (value for value, kind in _of_packs(store) if kind != RECORD)


def _of_files(store: Store, folder: str, pattern: re.Pattern[str]) -> Iterator[_Value]:
    for file in _files(store.root / folder):
        digest = _own_name(file, pattern)
        stat = _stat(file.path) if digest else None
        if stat is not None:
            yield _Value(Path(file.path), digest, stat.st_size, stat.st_mtime)


def _of_packs(store: Store) -> Iterator[tuple[_Value, str]]:
    times = store.blobs.packs.times()
    for packed in store.blobs.packs.each():
        used_s = max(packed.time_s, times.get(packed.pack, 0.0))
        yield _Value(packed, packed.digest, packed.size_bytes, used_s), packed.kind


def _intact_records(store: Store) -> Iterator[tuple[_Value, UnitRecord]]:
    for value in _records(store):
        record = record_from_bytes(_read(value.place) or b"")
        if record is not None and record.key == value.digest:
            yield value, record


def _own_name(file: os.DirEntry[str], pattern: re.Pattern[str]) -> str:
    """Return the digest in the name of a file of the cache; empty if the file does not belong to the cache."""
    match = pattern.fullmatch(file.name)
    if match is None or Path(file.path).parent.name != match[1][:FOLDER_DIGITS]:
        return ""
    return match[1] if file.is_file(follow_symlinks=False) else ""


def _read(place: Path | Packed) -> bytes | None:
    """Return the bytes of a value, or None if another process has deleted it."""
    with suppress(FileNotFoundError), _reading(place):
        return place.read_bytes() if isinstance(place, Packed) else read_regular(place)
    return None


def _digest(place: Path | Packed) -> str:
    """Return the digest of a value, or nothing if another process has deleted it, or it is not a regular file."""
    with suppress(FileNotFoundError), _reading(place):
        if isinstance(place, Packed) or stat.S_ISREG(place.lstat().st_mode):
            return place.content_digest() if isinstance(place, Packed) else digest_from_file(place)
    return ""


def _stat(path: str | Path) -> os.stat_result | None:
    with suppress(FileNotFoundError), _reading(path):
        return Path(path).lstat()
    return None


@contextmanager
def _reading(place: str | Path | Packed) -> Iterator[None]:
    """Name a file that cannot be read, unless it is missing."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        path = place.pack if isinstance(place, Packed) else place
        raise StoreError(
            f"{path} cannot be read: {error.strerror}. Check the permissions of the cache and its disk"
        ) from error


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield the files below a folder, and folders that have the name of a file of the cache, sorted by name.

    Links are not followed.
    """
    for entry in _sorted(folder):
        if entry.is_dir(follow_symlinks=False) and not _BLOB_NAME.fullmatch(entry.name):
            yield from _files(Path(entry.path))
        else:
            yield entry


def _sorted(folder: Path) -> Iterable[os.DirEntry[str]]:
    with suppress(FileNotFoundError), _reading(folder), os.scandir(folder) as entries:
        return sorted(entries, key=lambda entry: entry.name)
    return ()
