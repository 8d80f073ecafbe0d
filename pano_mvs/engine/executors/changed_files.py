"""Check that the input files of a unit are still those whose digests are in its cache key."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.core.errors import InputError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.stages.params import key_fields
from pano_mvs.scene.record import changed_text, vanished_text


def changed_items(unit: Unit, store: Store) -> dict[str, str]:
    """Return the files of a capture that a unit reads and that have changed since they were listed, with the reasons.

    Files whose size, time stamps and inode are unchanged are not read.
    """
    listed = {store.blobs.path(ref): ref.digest for ref in unit.input_blobs() if ref.external}
    if unit.source is not None:
        listed |= {unit.source.files[role]: digest for role, digest in unit.source.digests.items()}
    found = {path: _reason(path, digest, store) for path, digest in listed.items()}
    return {str(path): reason for path, reason in found.items() if reason}


def changed_settings(unit: Unit, store: Store) -> list[str]:
    """Return a reason for each file in a unit's settings that has changed since the key was made."""
    digests = unit.identity["params"]
    pairs = [
        pair
        for name, paths in key_fields(unit.entry.params)[1].items()
        for pair in zip(paths, digests[name], strict=True)
    ]
    return [reason for path, digest in pairs if (reason := _reason(path, digest, store))]


def _reason(path: Path, digest: str, store: Store) -> str:
    try:
        if store.stat_cache.digest(path) == digest:
            return ""
        store.stat_cache.forget(path)  # its entry may be damaged
        return "" if store.stat_cache.digest(path) == digest else changed_text(path)
    except InputError:
        return vanished_text(path)
