"""What the sources of a run listed when it began: later passes of the same run use the same list.

A file that changed or vanished after it was listed costs its item. The item is taken out, and the run goes over its
stages once more: every result is then the same as that of a capture without the item, whenever the file changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.errors import ChangedFileError, InputError
from pano_mvs.engine.cache.stat_cache import State
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.stages.stage import SourceItem
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene.record import changed_text, vanished_text


@dataclass(frozen=True, slots=True)
class _ListedFile:
    digest: str
    state: State | None


@dataclass(slots=True)
class SourceListing:
    """The items of a run's sources, and the digests under which their files are used.

    Attributes:
        lost: file to the reason why it cannot be used any more in this run.
    """

    lost: dict[Path, str] = field(default_factory=dict)
    _items: dict[str, tuple[SourceItem, ...]] = field(default_factory=dict)
    _files: dict[Path, _ListedFile] = field(default_factory=dict)
    _reported: dict[Path, str] = field(default_factory=dict)

    def items(self, entry: StageEntry) -> tuple[SourceItem, ...]:
        """Return what a source offers, as it was when it was first asked.

        Raises:
            InputError: if the list cannot be made.
        """
        assert entry.spec.list_items is not None
        if entry.name not in self._items:
            self._items[entry.name] = tuple(entry.spec.list_items(entry.params))
        return self._items[entry.name]

    def digest(self, path: Path, store: Store) -> str:
        """Return the digest of a listed file, and make the file findable by it.

        Raises:
            ChangedFileError: if the file is not the one that was listed.
            InputError: if it cannot be read.
        """
        if path in self.lost:
            raise ChangedFileError(self.lost[path], path)
        known = self._files.get(path)
        known = self._listed(path, store) if known is None else self._checked(path, known, store)
        self._files[path] = known
        return known.digest

    def report(self, changed: Mapping[str, str]) -> bool:
        """Take note of files that a unit did not find as they were listed; return whether any of them was listed."""
        known = {Path(path): reason for path, reason in changed.items()}
        by_absolute = {path.absolute(): path for path in self._files}
        found = {by_absolute[path.absolute()]: why for path, why in known.items() if path.absolute() in by_absolute}
        self._reported |= found
        return bool(found)

    def _listed(self, path: Path, store: Store) -> _ListedFile:
        state = store.stat_cache.state(path)  # first: what changes from here on is noticed
        try:
            return _ListedFile(store.blobs.register_external(path), state)
        except InputError as error:
            self.lost[path] = str(error)
            raise

    def _checked(self, path: Path, known: _ListedFile, store: Store) -> _ListedFile:
        """Return a file as it is listed from now on: as before, or as it really was if the stat cache was wrong."""
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
            return _ListedFile(digest, state)  # nobody has touched it: a damaged stat cache had another digest for it
        if digest != known.digest or reason:
            self.lost[path] = reason or changed_text(path)
            raise ChangedFileError(self.lost[path], path)
        return known
