"""Maintenance of a cache: its contents by stage, verification, and garbage collection.

Garbage collection keeps what the remembered runs and pins name, and deletes everything else that is older than a given
age. It takes no lock: what a run has just computed is too recent to be deleted, and a run computes again what is
missing.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.digest import DIGEST_BYTES, IS_DIGEST, digest_from_file
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import whose_temporary
from pano_mvs.engine.cache.blobs import SUFFIX
from pano_mvs.engine.cache.latest_runs import RunEntry
from pano_mvs.engine.cache.store import Store, UnitRecord, record_from_bytes
from pano_mvs.engine.cache.unproven import Unproven

_BLOB_NAME = re.compile(rf"({IS_DIGEST.pattern}){SUFFIX.pattern}")
_RECORD_NAME = re.compile(rf"({IS_DIGEST.pattern})\.json")


@dataclass(frozen=True, slots=True)
class StageUsage:
    """The results of one stage in a cache.

    Attributes:
        stage: name of the stage in the registry.
        units: number of finished units.
        size_bytes: size of their blobs; a blob that several units share counts once.
        seconds: their computing time.
    """

    stage: str
    units: int
    size_bytes: int
    seconds: float


@dataclass(slots=True)
class Verification:
    """What a verification found.

    Attributes:
        records: number of intact records.
        blobs: number of intact blobs.
        removed: damaged files, which were removed; the next run computes them again.
        incomplete: records with missing blobs, which runs ignore.
        foreign: files that do not belong to the cache.
        temporary: temporary files, each with the process that it belongs to.
        unproven: records of earlier versions that may have been computed from other input files than their keys say.
    """

    records: int = 0
    blobs: int = 0
    removed: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    temporary: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)


@dataclass(slots=True)
class GarbageCollection:
    """What a garbage collection deletes, or would delete.

    Attributes:
        runs: remembered runs that are too old.
        records: paths of records.
        blobs: paths of blobs.
        size_bytes: size of both.
        kept_bytes: size of the blobs that are kept.
    """

    runs: list[RunEntry] = field(default_factory=list)
    records: list[str] = field(default_factory=list)
    blobs: list[str] = field(default_factory=list)
    size_bytes: int = 0
    kept_bytes: int = 0


def usage_of(store: Store) -> list[StageUsage]:
    """Return the results of each stage in a cache, the largest first."""
    seen: set[str] = set()
    totals: dict[str, list[float]] = {}
    for _, record in _records(store):
        total = totals.setdefault(_stage_of(record), [0, 0, 0.0])
        total[0] += 1
        total[2] += record.seconds
        for ref in record.own_blobs():
            if ref.digest not in seen:
                seen.add(ref.digest)
                total[1] += ref.size_bytes
    found = [StageUsage(name, int(units), int(size), seconds) for name, (units, size, seconds) in totals.items()]
    return sorted(found, key=lambda usage: (-usage.size_bytes, usage.stage))


def size_on_disk(store: Store) -> int:
    """Return the size of all files of a cache."""
    stats = (_stat(file.path) for file in _files(store.root))
    return sum(stat.st_size for stat in stats if stat is not None)


def verify(store: Store, *, drop_unproven: bool = False) -> Verification:
    """Check every record and every blob against its digest, and remove damaged ones; foreign files are kept.

    Runs may use the cache at the same time.

    Args:
        store: the cache.
        drop_unproven: also remove the records of earlier versions whose results cannot be proven, see `unproven`.

    Raises:
        StoreError: if a file cannot be read or removed.
    """
    found, unproven = Verification(), Unproven()
    intact: set[str] = set()
    for file in _files(store.root / "blobs"):
        name = _own_name(store, file, _BLOB_NAME)
        if not name:
            found.foreign.append(file.path)
            continue
        digest = _digest(file.path)
        if digest == name:
            intact.add(file.name)
            found.blobs += 1
        elif digest:
            _remove(Path(file.path))
            found.removed.append(file.path)
    for file in _files(store.root / "records"):
        key = _own_name(store, file, _RECORD_NAME)
        data = _read(file.path) if key else None
        if not key:
            found.foreign.append(file.path)
        elif data is not None:
            record = _verify_record(store, file.path, found=found, intact=intact, key=key, data=data)
            stat = _stat(file.path)
            if record is not None and stat is not None:
                unproven.add(file.path, stat.st_mtime, record)
    found.unproven = list(unproven.paths(store.stat_cache))
    for path in found.unproven if drop_unproven else ():
        _remove(Path(path))
    for entry in _sorted(store.blobs.temporary):
        found.temporary.append(f"{entry.path} ({whose_temporary(Path(entry.path))})")
    return found


def _verify_record(
    store: Store, path: str, *, found: Verification, intact: set[str], key: str, data: bytes
) -> UnitRecord | None:
    """Check a record and enter it into what was found; return it if it and all its blobs are intact."""
    record = record_from_bytes(data)
    if record is None or record.key != key:
        _remove(Path(path))
        found.removed.append(path)
        return None
    # A running workflow may have written other blobs after the blobs were checked.
    blobs = (ref for ref in record.own_blobs() if f"{ref.digest}{ref.suffix}" not in intact)
    if all(_digest(store.blobs.path(ref)) == ref.digest for ref in blobs):
        found.records += 1
        return record
    found.incomplete.append(path)
    return None


def collect(
    store: Store, *, unused_s: float, forget_after_s: float | None = None, delete: bool = False
) -> GarbageCollection:
    """Find, and optionally delete, what no remembered run and no pin names.

    Args:
        store: the cache.
        unused_s: keep what was computed within this time.
        forget_after_s: forget runs that ended longer ago than this; None forgets none. Pins are kept.
        delete: delete what was found.

    Raises:
        StoreError: if a remembered run is damaged, so that it is not known what it protects, or if a file cannot be
            read or deleted.
    """
    found = GarbageCollection()
    newest = time.time() - unused_s
    kept_keys: set[bytes] = set()
    for entry in store.runs.each():
        if not entry.pinned and forget_after_s is not None and entry.age_s() > forget_after_s:
            found.runs.append(entry)
        else:
            kept_keys.update(_packed(key) for units in entry.keys.values() for key in units.values())
    kept_blobs: set[bytes] = set()
    for file, record in _records(store):
        stat = _stat(file.path)
        if stat is not None and _packed(record.key) not in kept_keys and stat.st_mtime <= newest:
            found.records.append(file.path)
            found.size_bytes += stat.st_size
        else:
            kept_blobs.update(_packed(ref.digest) for ref in record.blobs())
    for file in _files(store.root / "blobs"):
        stat = _stat(file.path)
        name = _own_name(store, file, _BLOB_NAME)
        if stat is None or not name:
            continue
        if _packed(name) in kept_blobs or stat.st_mtime > newest:
            found.kept_bytes += stat.st_size
        else:
            found.blobs.append(file.path)
            found.size_bytes += stat.st_size
    if delete:
        _delete(store, found, newest)
    return found


def _delete(store: Store, found: GarbageCollection, newest: float) -> None:
    """Delete records before the blobs that they name, so that no record is left without its blobs."""
    for entry in found.runs:
        store.runs.forget(entry)
    for path in (*found.records, *found.blobs):
        stat = _stat(path)
        if stat is not None and stat.st_mtime <= newest:  # otherwise a run has used it in the meantime
            _remove(Path(path))


def _packed(digest: str) -> bytes:
    """Return the first half of a digest as bytes, to save memory; empty if the text is not a digest.

    Even among millions of digests no two begin alike. If two did, one file too many would be kept.
    """
    return bytes.fromhex(digest[:DIGEST_BYTES]) if IS_DIGEST.fullmatch(digest) else b""


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be deleted: {error.strerror}. Check the permissions of the cache") from error


def _records(store: Store) -> Iterator[tuple[os.DirEntry[str], UnitRecord]]:
    """Yield every intact record."""
    for file in _files(store.root / "records"):
        key = _own_name(store, file, _RECORD_NAME)
        record = record_from_bytes(_read(file.path) or b"") if key else None
        if record is not None and record.key == key:
            yield file, record


def _stage_of(record: UnitRecord) -> str:
    return str(record.identity.get("stage", "unknown"))


def _own_name(store: Store, file: os.DirEntry[str], pattern: re.Pattern[str]) -> str:
    """Return the digest in the name of a file of the cache; empty if the file does not belong to the cache."""
    match = pattern.fullmatch(file.name)
    if match is None or Path(file.path).parent.name != match[1][: store.folder_digits]:
        return ""
    return match[1] if file.is_file(follow_symlinks=False) else ""


def _read(path: str) -> bytes | None:
    """Return the bytes of a file, or None if another process has deleted it."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _cannot_read(path, error) from error


def _digest(path: str | Path) -> str:
    try:
        return digest_from_file(Path(path))
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise _cannot_read(path, error) from error


def _stat(path: str | Path) -> os.stat_result | None:
    try:
        return Path(path).lstat()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _cannot_read(path, error) from error


def _cannot_read(path: str | Path, error: OSError) -> StoreError:
    return StoreError(f"{path} cannot be read: {error.strerror}. Check the permissions of the cache and its disk")


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield the files below a folder, sorted by name; links are not followed."""
    for entry in _sorted(folder):
        if entry.is_dir(follow_symlinks=False):
            yield from _files(Path(entry.path))
        else:
            yield entry


def _sorted(folder: Path) -> Iterable[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise _cannot_read(folder, error) from error
