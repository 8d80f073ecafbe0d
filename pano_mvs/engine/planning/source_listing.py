"""The items that the sources of a run listed at its start; later passes of the run use the same list.

If a file changes or disappears after it was listed, its item is left out and the run makes another pass. All results
are then those of a capture without the item, no matter when the file changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.errors import ChangedFileError, InputError
from pano_mvs.engine.cache.stat_cache import State
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.stages.stage import SourceItem
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene.record import changed_text, vanished_text


@dataclass(frozen=True, slots=True)
class _ListedFile:
    digest: str
    state: State | None


@dataclass(slots=True)
class SourceListing:
    """The items of the sources of a run, and the digests of their files.

    Attributes:
        lost: file to the reason why this run cannot use it any more.
    """

    lost: dict[Path, str] = field(default_factory=dict)
    _items: dict[str, tuple[SourceItem, ...]] = field(default_factory=dict)
    _files: dict[Path, _ListedFile] = field(default_factory=dict)
    _reported: dict[Path, str] = field(default_factory=dict)

    def items(self, entry: StageEntry) -> tuple[SourceItem, ...]:
        """Return the items of a source, as they were when it first listed them.

        Raises:
            InputError: if the list cannot be made.
        """
        assert entry.spec.list_items is not None
        if entry.name not in self._items:
            self._items[entry.name] = tuple(entry.spec.list_items(entry.params))
        return self._items[entry.name]

    def size(self) -> CaptureSize:
        """Return the size of the capture: that of the source with the most images."""
        files = [[tuple(item.files.values()) for item in items if not item.problem] for items in self._items.values()]
        return CaptureSize.of_files(max(files, key=len, default=[]))

    def digest(self, path: Path, store: Store) -> str:
        """Return the digest of a listed file, and register the file with the store under it.

        Raises:
            ChangedFileError: if the file has changed since it was listed.
            InputError: if it cannot be read.
        """
        if path in self.lost:
            raise ChangedFileError(self.lost[path], path)
        known = self._files.get(path)
        known = self._listed(path, store) if known is None else self._checked(path, known, store)
        self._files[path] = known
        return known.digest

    def report(self, changed: Mapping[str, str]) -> bool:
        """Record files that a unit found changed; return whether any of them is a listed one."""
        known = {Path(path): reason for path, reason in changed.items()}
        by_absolute = {path.absolute(): path for path in self._files}
        found = {by_absolute[path.absolute()]: why for path, why in known.items() if path.absolute() in by_absolute}
        self._reported |= found
        return bool(found)

    def _listed(self, path: Path, store: Store) -> _ListedFile:
        state = store.stat_cache.state(path)  # before the digest, so that later changes are noticed
        try:
            return _ListedFile(store.blobs.register_external(path), state)
        except InputError as error:
            self.lost[path] = str(error)
            raise

    def _checked(self, path: Path, known: _ListedFile, store: Store) -> _ListedFile:
        """Return the entry of a file: as before, or with the right digest if the stat cache had a wrong one."""
        reason = self._reported.pop(path, "")
        try:
            if reason:
                store.stat_cache.forget(path)
            digest = store.blobs.register_external(path)
        except InputError as error:
            self.lost[path] = vanished_text(path)
            raise ChangedFileError(self.lost[path], path) from error
        state = store.stat_cache.state(path)
        if digest != known.digest and state == known.state and reason:
            return _ListedFile(digest, state)  # the file is unchanged: a damaged stat cache had a wrong digest
        if digest != known.digest or reason:
            self.lost[path] = reason or changed_text(path)
            raise ChangedFileError(self.lost[path], path)
        return known
