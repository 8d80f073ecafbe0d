"""Drop the results of temporary stages: their arrays and files go, and their records stay.

A dropped record still names the digests of its result. So the units that read it keep their keys, and a run does not
need the result itself unless it computes one of them again.

Never dropped are the blobs that another record names, the results of pinned runs, and those that a remembered run
needs, be it a run of another workflow in which the stage is not temporary. A record is marked before its blobs go: if
the process is killed in between, garbage collection deletes them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from pano_mvs.core.digest import IS_DIGEST
from pano_mvs.core.errors import StoreError
from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.maintenance import each_record, pack
from pano_mvs.engine.cache.packs import Packed
from pano_mvs.engine.cache.store import Store, UnitRecord, is_droppable, record_from_bytes

_NAMED_BLOB = re.compile(rf'\["({IS_DIGEST.pattern})", '.encode())
_IS_DROPPED = b'"dropped": true'  # or a setting of this name


def drop_unneeded(store: Store) -> int:
    """Drop the results that no remembered run needs, of the stages that are temporary in these runs.

    Returns:
        The size of the deleted blobs in bytes.

    Raises:
        StoreError: if a remembered run is damaged, or a record or an index cannot be written.
    """
    unneeded, needed = set[str](), set[str]()
    for entry in store.runs.each():
        for stage, units in entry.keys.items():
            (unneeded if stage in entry.temporary else needed).update(units.values())  # in a pin, none is temporary
    return _drop(store, unneeded - needed)


@contextmanager
def dropping_after(roots: Iterable[Path]) -> Iterator[None]:
    """Let runs that share units drop nothing, and drop and pack what they do not need when all have ended.

    Nothing is dropped after an error, since the same command then goes on.

    Args:
        roots: the caches of the runs.
    """
    with ExitStack() as stack:
        stores = [Store(root, for_reading=True) for root in dict.fromkeys(roots)]
        alone = [stack.enter_context(store.in_use()) for store in stores]
        yield
        for store, is_alone in zip(stores, alone, strict=True):
            if is_alone():
                with suppress(StoreError):  # the next run drops them
                    drop_unneeded(store)
                    pack(store)


def drop_results(store: Store, keys: Iterable[str], *, needed: Collection[str]) -> int:
    """Drop the results of some units of a run that goes on, unless a remembered run needs them.

    Args:
        keys: of the units.
        needed: keys of the other units of the run.

    Returns, Raises:
        As `drop_unneeded`.
    """
    own = set(keys).difference(needed)
    for entry in store.runs.each():
        for stage, units in entry.keys.items():
            if stage not in entry.temporary:
                own.difference_update(units.values())
    return _drop(store, own)


def _drop(store: Store, keys: Collection[str]) -> int:
    """Drop the results of units."""
    found = (store.read_record(key) for key in sorted(keys))
    records = [record for record in found if record is not None and has_droppable(record, store)]
    if not records:
        return 0
    kept = _digests_in_use(store, {record.key for record in records})
    store.replace(replace(record, dropped=True) for record in records if not record.dropped)
    blobs = {ref for record in records for ref in record.blobs() if is_droppable(ref) and ref.digest not in kept}
    return _delete(store, blobs)


def has_droppable(record: UnitRecord, store: Store) -> bool:
    """Return whether the cache has anything of a result that could be dropped."""
    return any(is_droppable(ref) and store.blobs.exists(ref) for ref in record.blobs())


def _digests_in_use(store: Store, dropped: Collection[str]) -> set[str]:
    """Return the digests of all blobs that records name, without some and without those that were dropped."""
    digests = set[str]()
    for key, data in each_record(store):  # their bytes are searched, which is several times as fast as reading them
        if key not in dropped and not _is_dropped(data):
            digests.update(digest.decode() for digest in _NAMED_BLOB.findall(data))
    return digests


def _is_dropped(data: bytes) -> bool:
    """Return whether the bytes of a record say that its result was dropped."""
    record = record_from_bytes(data) if _IS_DROPPED in data else None
    return record is not None and record.dropped


def _delete(store: Store, blobs: Iterable[BlobRef]) -> int:
    """Delete blobs, also those that are in a file and in packs, and return their size in bytes."""
    size_bytes, packs = 0, set[Path]()
    waiting, tried = list(blobs), set[Packed]()  # a pack that is missing keeps its index
    while waiting:
        packed = list[Packed]()
        for ref in waiting:
            place = store.blobs.forget(ref)
            if isinstance(place, Packed) and place not in tried:
                packed.append(place)
                size_bytes += place.size_bytes
            path = store.blobs.path(ref)
            with suppress(OSError):  # missing, or mapped on Windows; garbage collection removes it
                path.unlink()
                size_bytes += ref.size_bytes
        store.blobs.packs.forget(packed)
        packs |= {place.pack for place in packed}
        tried.update(packed)
        again = {place.digest for place in packed}
        waiting = [ref for ref in waiting if ref.digest in again and store.blobs.exists(ref)]
    store.blobs.packs.rewrite(packs)
    return size_bytes
