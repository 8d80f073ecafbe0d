"""Look after a store: what it holds, whether it is sound, and what nothing needs any more.

A collection marks what the runs and the pins of the book name, and sweeps the rest once it has not been computed for a
while. It takes no lock: what a run has just computed is too young to be swept, and a run that finds something gone
computes it again.
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
    """What one stage has in a store.

    Attributes:
        stage: its name in the registry.
        units: finished units.
        size_bytes: of their blobs; what several units share counts for the first.
        seconds: what they took to compute.
    """

    stage: str
    units: int
    size_bytes: int
    seconds: float


@dataclass(slots=True)
class Verification:
    """What a verification found.

    Attributes:
        records: sound records.
        blobs: sound blobs.
        removed: damaged files, which were removed: the next run computes them again.
        incomplete: records whose blobs are gone, which count as not there.
        foreign: files that are none of the store's.
        temporary: what lies in its folder for temporary files, and whose it is.
        unproven: records of earlier versions that may be of other bytes of the user's files than their keys say.
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
    """What a collection would remove, or removed.

    Attributes:
        runs: entries of the book that are too old.
        records: paths.
        blobs: paths.
        size_bytes: of both.
        kept_bytes: of the blobs that stay.
    """

    runs: list[RunEntry] = field(default_factory=list)
    records: list[str] = field(default_factory=list)
    blobs: list[str] = field(default_factory=list)
    size_bytes: int = 0
    kept_bytes: int = 0


def usage_of(store: Store) -> list[StageUsage]:
    """Return what each stage has in a store, the largest first."""
    seen: set[str] = set()
    totals: dict[str, list[float]] = {}
    for _, record in _records(store):
        total = totals.setdefault(_stage_of(record), [0, 0, 0.0])
        total[0] += 1
        total[2] += record.seconds
        for ref in record.blobs():
            if not ref.external and ref.digest not in seen:
                seen.add(ref.digest)
                total[1] += ref.size_bytes
    found = [StageUsage(name, int(units), int(size), seconds) for name, (units, size, seconds) in totals.items()]
    return sorted(found, key=lambda usage: (-usage.size_bytes, usage.stage))


def size_on_disk(store: Store) -> int:
    """Return the bytes of all files of a store."""
    stats = (_stat(file.path) for file in _files(store.root))
    return sum(stat.st_size for stat in stats if stat is not None)


def verify(store: Store, *, drop_unproven: bool = False) -> Verification:
    """Check every record and every blob against its digest; damaged ones are removed, what is foreign stays.

    Runs may go on meanwhile.

    Args:
        store: the store.
        drop_unproven: remove the records of earlier versions whose results cannot be proven, see `unproven`.

    Raises:
        StoreError: if a file cannot be read or removed.
    """
    damage, unproven = Verification(), Unproven()
    sound: set[str] = set()
    for file in _files(store.root / "blobs"):
        name = _own_name(store, file, _BLOB_NAME)
        if not name:
            damage.foreign.append(file.path)
            continue
        found = _digest(file.path)
        if found == name:
            sound.add(file.name)
            damage.blobs += 1
        elif found:
            _remove(Path(file.path))
            damage.removed.append(file.path)
    for file in _files(store.root / "records"):
        key = _own_name(store, file, _RECORD_NAME)
        data = _read(file.path) if key else None
        if not key:
            damage.foreign.append(file.path)
        elif data is not None:
            record = _verify_record(store, damage, sound, file.path, key=key, data=data)
            stat = _stat(file.path)
            if record is not None and stat is not None:
                unproven.add(file.path, stat.st_mtime, record)
    damage.unproven = list(unproven.paths(store.stat_cache))
    for path in damage.unproven if drop_unproven else ():
        _remove(Path(path))
    for entry in _sorted(store.blobs.temporary):
        damage.temporary.append(f"{entry.path} ({whose_temporary(Path(entry.path))})")
    return damage


def _verify_record(
    store: Store, damage: Verification, sound: set[str], path: str, *, key: str, data: bytes
) -> UnitRecord | None:
    """Enter a record into what was found; return it if it and all its blobs are sound."""
    record = record_from_bytes(data)
    if record is None or record.key != key:
        _remove(Path(path))
        damage.removed.append(path)
        return None
    # What is not known to be sound may have come, from a run that goes on, after the blobs were checked.
    blobs = (ref for ref in record.blobs() if not ref.external and f"{ref.digest}{ref.suffix}" not in sound)
    if all(_digest(store.blobs.path(ref)) == ref.digest for ref in blobs):
        damage.records += 1
        return record
    damage.incomplete.append(path)
    return None


def collect(
    store: Store, *, unused_s: float, forget_after_s: float | None = None, delete: bool = False
) -> GarbageCollection:
    """Find, and if asked remove, what no run and no pin of the book names.

    Args:
        store: the store.
        unused_s: what was computed within this time stays, needed or not.
        forget_after_s: forget runs that ended longer ago than this; None forgets none. Pins stay.
        delete: remove; else only tell.

    Raises:
        StoreError: if an entry of the book is damaged, since what it protects is not known; or a file cannot be read
            or removed.
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
    """Remove records before the blobs that they name, so that no sound record is left without them."""
    for entry in found.runs:
        store.runs.forget(entry)
    for path in (*found.records, *found.blobs):
        stat = _stat(path)
        if stat is not None and stat.st_mtime <= newest:  # else a run has come to use it meanwhile
            _remove(Path(path))


def _packed(digest: str) -> bytes:
    """Return the first half of a digest as bytes, which take half the memory; nothing if it is no digest.

    Of millions of digests no two begin alike. If two did, a file too many would be kept.
    """
    return bytes.fromhex(digest[:DIGEST_BYTES]) if IS_DIGEST.fullmatch(digest) else b""


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be deleted: {error.strerror}. Mend the permissions of the cache") from error


def _records(store: Store) -> Iterator[tuple[os.DirEntry[str], UnitRecord]]:
    """Yield every record that is sound."""
    for file in _files(store.root / "records"):
        key = _own_name(store, file, _RECORD_NAME)
        record = record_from_bytes(_read(file.path) or b"") if key else None
        if record is not None and record.key == key:
            yield file, record


def _stage_of(record: UnitRecord) -> str:
    return str(record.identity.get("stage", "unknown"))


def _own_name(store: Store, file: os.DirEntry[str], pattern: re.Pattern[str]) -> str:
    """Return the digest in the name of a file that a store has written there, or nothing if it is no such file."""
    match = pattern.fullmatch(file.name)
    if match is None or Path(file.path).parent.name != match[1][: store.folder_digits]:
        return ""
    return match[1] if file.is_file(follow_symlinks=False) else ""


def _read(path: str) -> bytes | None:
    """Return the bytes of a file, None if it is gone: others look after the store too."""
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
    return StoreError(f"{path} cannot be read: {error.strerror}. Mend the permissions of the cache, or check its disk")


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield the files below a folder in order of their names; links are not followed."""
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
