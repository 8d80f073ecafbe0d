"""The cache: a small record for each finished unit, by key, and immutable blobs with the values.

Layout under the root: `blobs/abc/<digest><suffix>`, `records/abc/<key>.json`, `packs/` (most blobs and records, if
there are many: `pano_mvs.engine.cache.packs`), `runs/<id>.json` (the key of each unit in the latest run of a workflow
into a folder, for the reasons in plans and for garbage collection), `pins/` (protected runs), `stat-cache.json`,
`unit-times.json` (for estimates), `tmp/`, `layout.json`, and an empty file that marks the folder as a cache.

What is cached follows from the records alone: there is no status file that could be wrong, and no lock. A record is
written after its blobs. Files get their names by renaming, are never changed, and are never links, so that any number
of runs on several hosts can share a cache, also on a network file system.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from sys import intern
from typing import Any

from pano_mvs.core.digest import DIGEST_BYTES, IS_DIGEST, digest_from_file, digest_from_value
from pano_mvs.core.errors import ContractError, StoreError, UsageError
from pano_mvs.core.files import (
    CACHE_MARK,
    checked_body,
    clear_abandoned,
    is_full_disk,
    is_older,
    make_folder,
    make_room,
    read_regular,
    temporary_prefix,
    write_checked,
    write_text,
)
from pano_mvs.core.paths import children, exists, is_folder, is_link, reason_of
from pano_mvs.engine.cache.blobs import FOLDER_DIGITS, BlobRef, BlobStore, DamagedBlobError, PackedRefs, refuse_link
from pano_mvs.engine.cache.latest_runs import RunHistory
from pano_mvs.engine.cache.packs import JSON, RECORD, Packed
from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.engine.cache.unit_times import FILE_NAME, UnitTimes
from pano_mvs.scene import Record

_FULL_BELOW_BYTES = 1_000_000

LAYOUT_VERSION = 3
READ_LAYOUTS = (2, LAYOUT_VERSION)  # in 2, nothing in packs is compressed
MIN_FREE_BYTES = 200_000_000
_RUN_MARK = "run-"
_FOLDERS = ("blobs", "records", "packs", "runs", "pins", "tmp")


class ItemRef:
    """A stored value: its kind, its parts, and the digest that represents it in the keys of other units.

    It is packed, because a run holds one for each unit.
    """

    __slots__ = ("_form", "_packed", "kind")

    def __init__(self, kind: str, digest: str, parts: Mapping[str, BlobRef]) -> None:
        """Make a reference.

        Raises:
            ValueError: if the digest is not one.
        """
        if not IS_DIGEST.fullmatch(digest):
            raise ValueError(f"not a digest: {digest!r}")
        found = parts if isinstance(parts, PackedRefs) else PackedRefs(parts)
        self.kind, self._form = kind, found.form
        self._packed = bytes.fromhex(digest) + found.packed

    @property
    def digest(self) -> str:
        """The digest of the value."""
        return self._packed[:DIGEST_BYTES].hex()

    @property
    def parts(self) -> PackedRefs:
        """The parts of the value by name."""
        return PackedRefs.from_packed(self._form, self._packed[DIGEST_BYTES:])

    def blobs(self) -> Iterable[BlobRef]:
        """Return the blobs of its parts."""
        return self.parts.values()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ItemRef):
            return NotImplemented
        if (self.kind, self._packed, self._form) == (other.kind, other._packed, other._form):
            return True
        same = (self.kind, self.digest) == (other.kind, other.digest)
        return same and self.parts == other.parts  # in any order

    __hash__ = None  # type: ignore[assignment]  # as that of the mapping of its parts

    def __repr__(self) -> str:
        return f"ItemRef(kind={self.kind!r}, digest={self.digest!r}, parts={self.parts!r})"

    def to_json(self) -> dict[str, Any]:
        """Return the reference as a JSON value."""
        return {"kind": self.kind, "digest": self.digest, "parts": {n: ref.to_json() for n, ref in self.parts.items()}}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> ItemRef:
        """Return the reference from the result of `to_json`."""
        parts = {str(name): BlobRef.from_json(part) for name, part in value["parts"].items()}
        return ItemRef(intern(str(value["kind"])), str(value["digest"]), PackedRefs(parts))


@dataclass(frozen=True, slots=True)
class UnitRecord:
    """The result of one finished unit of work."""

    key: str
    identity: Mapping[str, Any]  # what the key was made of, for the reasons in plans
    output: ItemRef
    items: Mapping[str, ItemRef] = field(default_factory=dict)  # the items of a collection, by image
    metrics: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    # image name to the reason why the result leaves it out
    rejected: Mapping[str, str] = field(default_factory=dict)
    # image name to the reason why the result is doubtful there
    doubts: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    # whether a run has dropped its arrays and files: they may be missing, and are computed again when they are read
    dropped: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the record as a JSON value."""
        return {
            **({"dropped": True} if self.dropped else {}),
            "key": self.key,
            "identity": self.identity,
            "output": self.output.to_json(),
            "items": {name: item.to_json() for name, item in self.items.items()},
            "metrics": dict(self.metrics),
            "notes": list(self.notes),
            "rejected": dict(self.rejected),
            "doubts": dict(self.doubts),
            "seconds": self.seconds,
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> UnitRecord:
        """Return the record from the result of `to_json`.

        Raises:
            ValueError, KeyError, TypeError, AttributeError, OverflowError: if the value is not a record.
        """
        identity, rejected, doubts = value["identity"], value["rejected"], value.get("doubts", {})
        if not all(isinstance(part, dict) for part in (identity, rejected, doubts)):
            raise TypeError("a record's identity and its rejected and doubtful images are objects")
        metrics = {intern(str(name)): float(metric) for name, metric in value["metrics"].items()}
        seconds = value["seconds"]
        if not all(map(math.isfinite, (*metrics.values(), seconds))):
            raise ValueError("a metric or a time is not finite")
        return UnitRecord(
            key=str(value["key"]),
            identity=identity,
            output=ItemRef.from_json(value["output"]),
            items={name: ItemRef.from_json(item) for name, item in value["items"].items()},
            metrics=metrics,
            notes=tuple(str(note) for note in value["notes"]),
            rejected={str(name): str(reason) for name, reason in rejected.items()},
            doubts={str(name): str(reason) for name, reason in doubts.items()},
            seconds=float(seconds),
            dropped=value.get("dropped") is True,
        )

    def blobs(self) -> Iterator[BlobRef]:
        """Yield all blobs of the record."""
        for item in (self.output, *self.items.values()):
            yield from item.parts.values()

    def own_blobs(self) -> Iterator[BlobRef]:
        """Yield the blobs that the record keeps in the cache: no files of the user, and nothing that was dropped."""
        return (ref for ref in self.lasting_blobs() if not ref.external)

    def lasting_blobs(self) -> Iterator[BlobRef]:
        """Yield all blobs without those that were dropped: JSON values stay, since they are small."""
        return (ref for ref in self.blobs() if not (self.dropped and is_droppable(ref)))


def is_droppable(ref: BlobRef) -> bool:
    """Return whether a blob goes when its result is dropped: an array or a file in the cache."""
    return not ref.external and ref.suffix != JSON


class Store:
    """The cache of one or many workflows."""

    def __init__(
        self, root: Path, *, durable: bool = False, min_free_bytes: int = MIN_FREE_BYTES, for_reading: bool = False
    ) -> None:
        """Open or create a store.

        Args:
            durable: flush every blob and record to the disk at once, so that they survive a power cut.
            min_free_bytes: no unit is started with less free space on the disk; 0 to disable this.
            for_reading: also accept a folder that cannot be written or created.

        Raises:
            UsageError: if the folder cannot be written, or has the layout of another version.
        """
        self.root = root
        self.durable = durable
        self.min_free_bytes = min_free_bytes
        self.damaged: list[str] = []
        self._records = str(root / "records")
        self._open_layout(for_reading=for_reading)
        clear_abandoned(self.root / "tmp", "*")
        self.runs = RunHistory(root)
        self.stat_cache = StatCache(root / "stat-cache.json")
        self.unit_times = UnitTimes(root / FILE_NAME)
        self.blobs = BlobStore(root, self.stat_cache, durable=durable)

    @property
    def is_empty(self) -> bool:
        """Whether no unit has a record."""
        return not children(self.root / "records") and not children(self.blobs.packs.folder)

    def find(self, key: str, *, or_dropped: bool = False) -> UnitRecord | None:
        """Return the record of a key if it is intact and all its blobs exist, otherwise None.

        Args:
            or_dropped: also return a record whose blobs a run has dropped. Its digests are known, so that the units
                that read it have keys, but it cannot be loaded.
        """
        record = self.read_record(key)
        if record is None:
            return None
        needed = record.lasting_blobs() if or_dropped else record.blobs()
        return record if all(map(self.blobs.exists, needed)) else None

    def read_record(self, key: str) -> UnitRecord | None:
        """Return the record of a key, whether or not its blobs exist; None if it is missing or damaged."""
        path = f"{self._records}/{key[:FOLDER_DIGITS]}/{key}.json"  # creating a Path takes as long as the rest
        packed: Packed | None = None
        for _ in range(2):  # again, because another process may have moved it meanwhile
            if (packed := self.packed_record(key, refresh=packed is not None)) is not None:
                with suppress(OSError):
                    return self._valid(packed.read_bytes(), key, packed.name)
            try:
                return self._valid(read_regular(path), key, path)
            except (FileNotFoundError, NotADirectoryError):
                if packed is None and self.packed_record(key) is None:
                    return None
            except OSError:
                self.damaged.append(path)
                return None
        return None

    def packed_record(self, key: str, *, refresh: bool = False) -> Packed | None:
        """Return where the record of a key is in the packs, or None if it is not there; see `Packs.find`."""
        found = self.blobs.packs.find(key, refresh=refresh) if IS_DIGEST.fullmatch(key) else None
        return found if found is not None and found.kind == RECORD else None

    def _valid(self, data: bytes, key: str, name: str) -> UnitRecord | None:
        record = record_from_bytes(data)
        if record is None or record.key != key:
            self.damaged.append(name)
            return None
        return record

    def put(self, record: UnitRecord) -> None:
        """Write a record; its blobs must already exist."""
        self._forget_packed([record.key])  # it could not be used
        self._write(record)

    def replace(self, records: Iterable[UnitRecord]) -> None:
        """Write records in place of those that have their keys; others see the old or the new ones meanwhile."""
        keys = list[str]()
        for record in records:
            self._write(record)
            keys.append(record.key)
        self._forget_packed(keys)

    def _forget_packed(self, keys: Iterable[str]) -> None:
        """Take records out of all packs that have them: caches that were copied into one another have some twice."""
        tried = set[Packed]()  # a pack that is missing keeps its index
        while packed := {found for key in keys if (found := self.packed_record(key)) is not None} - tried:
            self.blobs.packs.forget(packed)
            tried |= packed
            keys = [found.digest for found in packed]

    def _write(self, record: UnitRecord) -> None:
        body = json.dumps(record.to_json(), sort_keys=True).encode()
        path = self.record_path(record.key)
        refuse_link(path)
        if is_folder(path):
            make_room(path)
        write_checked(path, body, temporary_in=self.blobs.temporary, durable=self.durable)

    def drop(self, key: str) -> None:
        """Remove a record that turned out to be unusable."""
        self._forget_packed([key])
        path = self.record_path(key)
        if not is_link(path.parent):
            make_room(path)

    def put_value(self, value: Record) -> ItemRef:
        """Store a value's parts and return its reference.

        Raises:
            ContractError: if the value violates the contract of its kind, or cannot be stored.
        """
        value.check()
        try:
            parts = {name: self.blobs.put(part) for name, part in value.to_parts().items()}
        except (TypeError, ValueError) as error:
            raise ContractError(f"{value.kind_name()} holds something that cannot be stored: {error}") from error
        digests = {name: [ref.digest, ref.suffix] for name, ref in parts.items()}
        digest = digest_from_value([value.kind_name(), value.kind_version, digests])
        return ItemRef(value.kind_name(), digest, PackedRefs(parts))

    def load(self, ref: ItemRef, kind: type[Record]) -> Record:
        """Return a stored value; its arrays are memory-mapped and read-only.

        Raises:
            DamagedBlobError: if a blob is damaged; it has been removed, and the next run computes it again.
            ContractError: if the value is of another kind.
        """
        try:
            parts = {name: self.blobs.get(part) for name, part in ref.parts.items()}
            try:
                return kind.from_parts(parts)
            except (TypeError, ValueError, KeyError, AttributeError, AssertionError) as error:
                if ref.kind != kind.kind_name():
                    raise ContractError(f"a stored {ref.kind} was read as a {kind.kind_name()}") from error
                errors = [
                    self.blobs.discard(part, f"is not a part of a {kind.kind_name()}") for part in ref.parts.values()
                ]
                raise errors[0] from error
        except DamagedBlobError as error:
            self.damaged.append(str(error))
            raise

    @contextmanager
    def in_use(self) -> Iterator[Callable[[], bool]]:
        """Mark the cache as used by a run, and yield a function that returns whether no other run uses it.

        Runs drop results only while no other one uses the cache, which might be about to read them.
        """
        mark = self.blobs.temporary / f"{temporary_prefix()}{_RUN_MARK}{uuid.uuid4().hex}"
        with suppress(OSError, StoreError):  # a cache of other users can be read, not written
            make_folder(mark.parent)
            mark.touch()

        def is_alone() -> bool:
            clear_abandoned(self.blobs.temporary)
            return not any(path != mark for path in children(self.blobs.temporary, f"*-{_RUN_MARK}*"))

        try:
            yield is_alone
        finally:
            with suppress(OSError):
                mark.unlink(missing_ok=True)

    def abandoned_mark(self) -> Path | None:
        """Return the mark of a run that may use the cache for more than a day, or has been killed elsewhere, if any."""
        marks = children(self.blobs.temporary, f"*-{_RUN_MARK}*")
        return next((path for path in marks if is_older(path, 24 * 3600.0)), None)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield the absolute path of an empty folder in the cache, removed afterwards.

        Raises:
            StoreError: if the disk is too full to start, or becomes full inside the context.
        """
        free = self._free_bytes()
        if free < self.min_free_bytes:
            raise StoreError(
                f"{free / 1e6:.0f} MB are free on the disk of the cache {self.root}, but "
                f"{self.min_free_bytes / 1e6:.0f} MB must stay free (--min-free). Make room (`pano-mvs cache gc` "
                "shows what can be deleted) and run the same command again: finished units stay in the cache"
            )
        parent = self.blobs.temporary
        try:
            make_folder(parent)
            folder = Path(tempfile.mkdtemp(dir=parent.absolute(), prefix=temporary_prefix()))
        except OSError as error:
            raise self.cannot_write(error) from error
        try:
            yield folder
            # A library that does not check its writes may have truncated a file on a full disk: keep nothing.
            if self._is_full():
                raise self._full()
        except StoreError:
            raise
        except Exception as error:
            # Libraries report a full disk in many ways: errors without a number, errors of their own, or not at all.
            if is_full_disk(error) or self._is_full():
                raise self._full() from error
            raise
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def cannot_write(self, error: OSError) -> StoreError:
        """Return the error for a cache that cannot be written, or whose disk is full."""
        if is_full_disk(error):
            return self._full()
        return StoreError(
            f"cache {self.root} cannot be written: {error.strerror or error}. Check its permissions, "
            "or choose another cache with --cache DIR"
        )

    def _is_full(self) -> bool:
        return self._free_bytes() < _FULL_BELOW_BYTES

    def _free_bytes(self) -> int:
        try:
            return shutil.disk_usage(self.root).free
        except OSError as error:
            raise StoreError(
                f"cache {self.root} cannot be read: {error.strerror}. Check its permissions, or choose another cache "
                "with --cache DIR"
            ) from error

    def _full(self) -> StoreError:
        return StoreError(
            f"the disk of the cache {self.root} is full, or your quota is used up. Make room (`pano-mvs cache gc` "
            "shows what can be deleted) and run the same command again: finished units stay in the cache"
        )

    def record_path(self, key: str) -> Path:
        """Return the path of the record of a key, whether or not it exists."""
        return self.root / "records" / key[:FOLDER_DIGITS] / f"{key}.json"

    def _open_layout(self, *, for_reading: bool) -> None:
        for name in _FOLDERS:
            if is_link(self.root / name):
                raise UsageError(
                    f"cache {self.root}: {name} is a link, so that files would be written elsewhere. "
                    "Remove it, or choose another cache with --cache DIR"
                )
        path = self.root / "layout.json"
        try:
            layout = json.loads(read_regular(path))
        except FileNotFoundError:
            try:
                self._create(path)
            except (UsageError, StoreError):
                if not for_reading:
                    raise
            return
        except OSError as error:
            raise UsageError(
                f"cache {self.root} cannot be read ({reason_of(error)}). Check its permissions, or choose "
                "another cache with --cache DIR"
            ) from error
        except (ValueError, RecursionError) as error:
            raise UsageError(
                f"{path} cannot be read ({error}), so that the layout of the cache is unknown. If this version made "
                "the cache, delete the file, and nothing is lost; otherwise choose another cache with --cache DIR"
            ) from error
        version = layout.get("layout") if isinstance(layout, dict) else None
        if type(version) is not int or version not in READ_LAYOUTS:
            raise UsageError(
                f"cache {self.root} has layout {layout!r}, but this version uses {LAYOUT_VERSION}. "
                "Choose another cache with --cache DIR"
            )
        mark = self.root / CACHE_MARK
        with suppress(OSError):
            if not exists(mark) and not is_link(mark):
                mark.touch()

    def mark_layout(self) -> None:
        """State the layout of this version before anything is stored that an earlier one cannot read.

        Raises:
            StoreError: if the cache cannot be written.
        """
        path = self.root / "layout.json"
        text = json.dumps({"layout": LAYOUT_VERSION})
        if read_regular(path) != text.encode():
            write_text(path, text)

    def _create(self, path: Path) -> None:
        try:
            write_text(self.root / CACHE_MARK, "")
            write_text(path, json.dumps({"layout": LAYOUT_VERSION}))
        except StoreError as error:
            if is_full_disk(error.__cause__):
                raise
            raise UsageError(
                f"cache {self.root} cannot be written ({error.__cause__ or error}). Choose another with --cache DIR"
            ) from error


def is_intact(place: Path | Packed, digest: str, *, is_record: bool) -> bool:
    """Return whether a stored value is what its name says: a record that has this key, or bytes that have this digest.

    Raises:
        OSError: if it cannot be read.
    """
    if is_record:
        record = record_from_bytes(place.read_bytes() if isinstance(place, Packed) else read_regular(place))
        return record is not None and record.key == digest
    return (place.content_digest() if isinstance(place, Packed) else digest_from_file(place)) == digest


def record_from_bytes(data: bytes) -> UnitRecord | None:
    """Return the record in the bytes of a file, or None if they do not match the digest in the first line."""
    try:
        return UnitRecord.from_json(json.loads(checked_body(data)))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
