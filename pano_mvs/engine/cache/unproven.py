"""Find results of early versions that may have been computed from other input files than their keys say.

Early versions did not compare the bytes that a unit read with the digests in its key; their records do not have
`checked`. Such a result is certain only if the input files have not changed since the unit started, that is, if their
change time (ctime), which programs cannot set back, is earlier. All other such results are unproven.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from pano_mvs.core.digest import IS_DIGEST
from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.engine.cache.store import UnitRecord

_SLACK_S = 1.0


@dataclass(frozen=True, slots=True)
class _Read:
    path: str
    began_s: float
    named: frozenset[str]


@dataclass(slots=True)
class Unproven:
    """Collects records, and determines which of them are unproven."""

    _files_in: dict[str, set[str]] = field(default_factory=dict)  # digest of a value to the digests of the files in it
    _reads: list[_Read] = field(default_factory=list)

    def add(self, path: str, written_s: float, record: UnitRecord) -> None:
        """Add a record.

        Args:
            path: its file.
            written_s: when the file was written, in seconds since the epoch.
            record: the record.
        """
        for item in (record.output, *record.items.values()):
            files = {ref.digest for ref in item.parts.values() if ref.external}
            if files:
                self._files_in.setdefault(item.digest, set()).update(files)
        if not record.checked:
            named = (*_digests(record.identity.get("inputs")), *_content_digests(record.identity.get("params")))
            self._reads.append(_Read(path, written_s - record.seconds - _SLACK_S, frozenset(named)))

    def paths(self, stat_cache: StatCache) -> Iterator[str]:
        """Yield the paths of the records that are unproven."""
        changed_s = stat_cache.times_of_change()
        for read in self._reads:
            files = {file for name in read.named for file in self._files_in.get(name, ())}
            files |= {name for name in read.named if name.startswith(_FILE)}
            if any(changed_s.get(name.removeprefix(_FILE), float("inf")) >= read.began_s for name in files):
                yield read.path


_FILE = "file:"


def _digests(value: Any) -> Iterator[str]:
    """Yield the digests of all values in the inputs of a record, and, with a prefix, of the files of a source."""
    if isinstance(value, str):
        if IS_DIGEST.fullmatch(value):
            yield value
    elif isinstance(value, dict):
        for name, inner in value.items():
            if name == "files" and isinstance(inner, dict):
                yield from (f"{_FILE}{digest}" for digest in inner.values())
            else:
                yield from _digests(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _digests(inner)


def _content_digests(params: Any) -> Iterator[str]:
    """Yield the digests of the files that settings name."""
    for value in params.values() if isinstance(params, dict) else ():
        found = [*_digests(value)] if isinstance(value, list) else []
        yield from (f"{_FILE}{digest}" for digest in found)
