"""Look after a store: what it holds, whether it is sound, and what nothing needs any more.

A collection marks what the runs and the pins of the book name, and sweeps the rest once it has not been used for a
while. It takes no lock: a run that finds a blob gone computes it again, and what a run has just written or found of use
is too young to be swept.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import StoreError
from pano_mvs.engine.runs import RunEntry
from pano_mvs.engine.store import Store, UnitRecord, record_from_bytes

_BLOB_NAME_LENGTH = 32


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
class Damage:
    """What a verification found.

    Attributes:
        records: sound records.
        blobs: sound blobs.
        removed: damaged files, which were removed: the next run computes them again.
        incomplete: records whose blobs are gone, which count as not there.
        foreign: files that are none of the store's.
    """

    records: int = 0
    blobs: int = 0
    removed: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Collection:
    """What a collection would remove, or removed.

    Attributes:
        runs: entries of the book that are too old.
        records: paths.
        blobs: paths.
        size_bytes: of both.
        kept_bytes: of the blobs that stay.
    """

    runs: list[RunEntry] = field(default_factory=list)
    records: list[Path] = field(default_factory=list)
    blobs: list[Path] = field(default_factory=list)
    size_bytes: int = 0
    kept_bytes: int = 0


def usage_of(store: Store) -> list[StageUsage]:
    """Return what each stage has in a store, the largest first."""
    seen: set[str] = set()
    totals: dict[str, list[float]] = {}
    for record in _records(store):
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
    return sum(entry.stat(follow_symlinks=False).st_size for entry in _files(store.root))


def verify(store: Store) -> Damage:
    """Check every record and every blob against its digest; damaged ones are removed."""
    damage = Damage()
    sound: set[str] = set()
    for entry in _files(store.root / "blobs"):
        name = entry.name[:_BLOB_NAME_LENGTH]
        if entry.is_symlink() or len(name) < _BLOB_NAME_LENGTH:
            damage.foreign.append(entry.path)
        elif digest_from_file(Path(entry.path)) == name:
            sound.add(entry.name)
            damage.blobs += 1
        else:
            _remove(Path(entry.path))
            damage.removed.append(entry.path)
    for entry in _files(store.root / "records"):
        path = Path(entry.path)
        record = None if entry.is_symlink() else record_from_bytes(path.read_bytes())
        if record is None or record.key != path.stem:
            _remove(path)
            damage.removed.append(entry.path)
        elif all(ref.external or f"{ref.digest}{ref.suffix}" in sound for ref in record.blobs()):
            damage.records += 1
        else:
            damage.incomplete.append(entry.path)
    return damage


def collect(store: Store, *, unused_s: float, forget_after_s: float | None = None, delete: bool = False) -> Collection:
    """Find, and if asked remove, what no run and no pin of the book names.

    Args:
        store: the store.
        unused_s: what was written or used within this time stays.
        forget_after_s: forget runs that ended longer ago than this; None forgets none. Pins stay.
        delete: remove; else only tell.

    Raises:
        StoreError: if an entry of the book is damaged, since what it protects is not known.
    """
    found = Collection()
    newest = time.time() - unused_s
    kept_keys: set[str] = set()
    for entry in store.runs.entries():
        if not entry.pinned and forget_after_s is not None and entry.age_s() > forget_after_s:
            found.runs.append(entry)
        else:
            kept_keys.update(key for units in entry.keys.values() for key in units.values())
    kept_blobs: set[str] = set()
    for file in _files(store.root / "records"):
        record = record_from_bytes(Path(file.path).read_bytes())
        if record is None or record.key in kept_keys or file.stat(follow_symlinks=False).st_mtime > newest:
            kept_blobs.update(f"{ref.digest}{ref.suffix}" for ref in (record.blobs() if record else ()))
        else:
            found.records.append(Path(file.path))
            found.size_bytes += file.stat(follow_symlinks=False).st_size
    for file in _files(store.root / "blobs"):
        stat = file.stat(follow_symlinks=False)
        if file.name in kept_blobs or stat.st_mtime > newest:
            found.kept_bytes += stat.st_size
        else:
            found.blobs.append(Path(file.path))
            found.size_bytes += stat.st_size
    if delete:
        _delete(store, found)
    return found


def _delete(store: Store, found: Collection) -> None:
    """Remove records before the blobs that they name, so that no sound record is left without them."""
    for entry in found.runs:
        store.runs.forget(entry)
    for path in (*found.records, *found.blobs):
        _remove(path)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be deleted: {error.strerror}. Mend the permissions of the cache") from error


def _records(store: Store) -> Iterator[UnitRecord]:
    for entry in _files(store.root / "records"):
        record = record_from_bytes(Path(entry.path).read_bytes())
        if record is not None:
            yield record


def _stage_of(record: UnitRecord) -> str:
    return str(record.identity.get("stage", "unknown"))


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
