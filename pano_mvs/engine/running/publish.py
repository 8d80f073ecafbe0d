"""Put a run's files into the output folder, from the store: what is there already is left alone."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

from pano_mvs.core.errors import ContractError, StoreError, UsageError
from pano_mvs.core.file_names import is_of_the_run
from pano_mvs.core.files import OUTPUT_MARK, clear_abandoned, copy_file, set_aside
from pano_mvs.core.paths import is_file, is_link, resolved
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.running.disk_guard import is_full_disk
from pano_mvs.scene import Files
from pano_mvs.scene.files import item_stems

_PLACEHOLDER = re.compile(r"\{(?:item|name)\}")


class _Owner(NamedTuple):
    """The unit that a file is of."""

    stage: str
    item: str


class NameClashError(UsageError):
    """A unit would write a file where another unit of its stage, or itself, writes one.

    Attributes:
        losers: the units of the same stage that were published before and are not any more, since files of theirs clash
            with those of this one: item to the reason.
    """

    def __init__(self, text: str, losers: Mapping[str, str] = MappingProxyType({})) -> None:
        self.losers = losers
        super().__init__(text)


class Publisher:
    """Writes the files of one run into one folder.

    Attributes:
        out: the folder.
        store: where their bytes are.
        written: the files that were written.
        published: every file of the run, and its digest.
        earlier: file to digest, as an earlier run, or an earlier pass of this one, wrote them.
        set_aside: file to what it is called now, of those that stood where one was to be written and are nobody's but
            the user's: edited since, or never a run's.
    """

    def __init__(self, out: Path, store: Store) -> None:
        """Check that the folder can be written.

        Raises:
            UsageError: if it cannot.
            StoreError: if its disk is full.
        """
        self.out = out
        self.store = store
        self.written: list[str] = []
        self.published: dict[str, str] = {}
        self.earlier: dict[str, str] = {}
        self.set_aside: dict[str, str] = {}
        self._owners: dict[str, _Owner] = {}  # of each file, the unit that comes first, even if it is not published
        self._folders: set[str] = set()
        self._delivered: set[_Owner] = set()
        self._lost: dict[_Owner, tuple[str, ...]] = {}  # units that clash to the files that they would have delivered
        self._stems: dict[str, str] = {}
        self._ranks: dict[str, int] = {}
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            kind = StoreError if is_full_disk(error) else UsageError
            raise kind(_cannot_write(out, error.strerror or str(error))) from error
        if not os.access(out, os.W_OK | os.X_OK):
            raise UsageError(_cannot_write(out, "permission denied"))
        try:
            if is_link(out / OUTPUT_MARK):
                (out / OUTPUT_MARK).unlink()  # what it leads to may not even exist yet
            (out / OUTPUT_MARK).touch()
        except OSError as error:
            raise StoreError(_cannot_write(out, error.strerror or str(error))) from error
        self._cleared: set[Path] = set()
        self._clear(out)

    def name_items(self, names: Iterable[str]) -> None:
        """Fix the `{item}` of each image: its path without the extension, kept where two would collide."""
        self._stems = item_stems(names)
        self._ranks = {name: rank for rank, name in enumerate(self._stems)}

    def begin_pass(self) -> None:
        """Take what was published so far for that of an earlier run: not all of it need be published again."""
        self.earlier |= self.published
        self.published = {}
        self._owners, self._folders, self._delivered, self._lost = {}, set(), set(), {}

    def publish(self, stage: str, item: str, ref: ItemRef, *, to: str = "") -> Mapping[str, str]:
        """Write the files of one unit, unless they are there with the right bytes.

        Of several units of one stage that write the same file, none is published but that of the image that comes
        first in the capture, and that one only if it does not clash over another file with one before it. So it does
        not matter which of them is computed first.

        Returns:
            The units of the same stage that were published before and are not any more, since files of theirs clash
            with those of this one: item to the reason.

        Raises:
            NameClashError: if files of this unit clash with one another, or with those of a unit that comes first;
                nothing is written then.
            UsageError: if two stages write the same file.
            StoreError: if a file cannot be written.
            DamagedBlobError: if the store's copy is damaged.
            ContractError: if a file would take the place of the run's own; nothing is written then.
        """
        owner = _Owner(stage, item)
        files: dict[str, BlobRef] = {}
        for target, blob in self._files(ref):
            name = str(PurePosixPath(to) / self._placed(target, item))
            if is_of_the_run(name):
                raise ContractError(
                    f"it delivers {name}, which is the run's own: change the stage's name for the file, or give it a "
                    "folder with `to: NAME`"
                )
            if name in files:
                raise NameClashError(f"it delivers {name} twice. Give each of its files a name of its own")
            files[name] = blob
        for name in files:
            if folder := next((folder for folder in _folders_of(name) if folder in files), ""):
                raise NameClashError(f"it delivers {folder} as a file and {name} inside of it. Rename one of them")
        lost, losers = self._resolved_clashes(owner, files)
        for loser in losers:
            self._withdraw(_Owner(stage, loser))
        for name in files:
            self._owners[name] = min(owner, self._owners.get(name, owner), key=self._order)
            self._folders.update(_folders_of(name))
        if lost:
            self._lost[owner] = tuple(files)
            raise NameClashError(lost, losers)
        for name, blob in files.items():
            self._write(name, blob)
            self.published[name] = blob.digest
        self._delivered.add(owner)
        return losers

    def _resolved_clashes(self, owner: _Owner, files: Mapping[str, BlobRef]) -> tuple[str, dict[str, str]]:
        """Return why a unit cannot be published, if it cannot, and the published items that have to give way to it."""
        lost, losers = "", {}
        for what, other in self._clashes(owner, files):
            if other.stage != owner.stage:
                raise UsageError(f"stages {other.stage!r} and {owner.stage!r} both write {what}; give one a folder of "
                                 "its own with `to: NAME`")  # fmt: skip
            if self._order(owner) > self._order(other):
                lost = lost or _clash(what, other.item)
            elif other in self._delivered:
                losers[other.item] = _clash(what, owner.item)
        return lost, losers

    def clash_causes(self) -> dict[tuple[str, str], str]:
        """Return why units were not published, whichever were computed first: stage and item to the reason."""
        return {
            (owner.stage, owner.item): next(
                _clash(what, other.item)
                for what, other in self._clashes(owner, files)
                if self._order(other) < self._order(owner)
            )
            for owner, files in self._lost.items()
        }

    def _clashes(self, owner: _Owner, files: Iterable[str]) -> Iterator[tuple[str, _Owner]]:
        """Yield what clashes, in words, with the unit whose file it is already."""
        for name in files:
            if (other := self._owners.get(name)) is not None and other != owner:
                yield name, other
            for folder in _folders_of(name):
                if (other := self._owners.get(folder)) is not None and other != owner:
                    yield f"{folder}, as a file and as a folder,", other
            if name in self._folders:
                inside = {other for path, other in self._owners.items() if path.startswith(f"{name}/")}
                yield from ((f"{name}, as a file and as a folder,", other) for other in sorted(inside - {owner}))

    def _order(self, owner: _Owner) -> tuple[int, str]:
        return self._ranks.get(owner.item, len(self._ranks)), owner.item

    def _withdraw(self, owner: _Owner) -> None:
        """Take the files of a unit out of the output folder again; what they clash with they still clash with."""
        self._delivered.remove(owner)
        self._lost[owner] = tuple(name for name, found in self._owners.items() if found == owner)
        for name in self._lost[owner]:
            del self.published[name]
            with suppress(ValueError):
                self.written.remove(name)
            (self.out / name).unlink(missing_ok=True)
            self._remove_emptied([name])

    def remove_stale(self, earlier: dict[str, str]) -> list[str]:
        """Delete files that an earlier run wrote and this one did not, if nobody has changed them since.

        Folders of these files that are empty then go with them; the output folder itself, and links, stay.
        """
        removed: list[str] = []
        for name, digest in earlier.items():
            path = self.out / name
            if name in self.published or not _is_inside(path, self.out) or not is_file(path):
                continue
            if self.store.stat_cache.digest(path) == digest:
                path.unlink()
                removed.append(name)
        self._remove_emptied(removed)
        return removed

    def _remove_emptied(self, removed: Iterable[str]) -> None:
        """Remove the folders in which the removed files lay, where nothing is left in them."""
        emptied = {folder for name in removed for folder in PurePosixPath(name).parents if folder.parts}
        for folder in sorted(emptied, key=lambda folder: len(folder.parts), reverse=True):
            path = self.out / folder
            if _is_inside(path, self.out) and not is_link(path):
                with suppress(OSError):  # it is not empty, or somebody else has removed it
                    path.rmdir()

    def _placed(self, target: str, item: str) -> str:
        texts = {"{item}": self._stems.get(item, item), "{name}": item}
        return _PLACEHOLDER.sub(lambda match: texts[match[0]], target)

    def _files(self, ref: ItemRef) -> list[tuple[str, BlobRef]]:
        """Return the targets of a unit's files and the blobs with their bytes, which are not read."""
        try:
            meta = self.store.blobs.get(ref.parts["meta"])
            assert isinstance(meta, dict)
            files = [(target, ref.parts[str(number)]) for number, target in enumerate(meta["targets"])]
            Files({target: self.out for target, _ in files}).check()
        except (KeyError, TypeError, ValueError, AssertionError) as error:
            raise DamagedBlobError(f"a cached list of files ({ref.digest}) is not what stages write ({error}); it is "
                                   "computed again")  from error  # fmt: skip
        return files

    def _clear(self, folder: Path) -> None:
        """Remove, once, what runs that were killed left half written in a folder."""
        if folder not in self._cleared:
            self._cleared.add(folder)
            clear_abandoned(folder)

    def _write(self, name: str, blob: BlobRef) -> None:
        target = self.out / name
        if not _is_inside(target, self.out):
            raise StoreError(_cannot_write(target, "it would leave the output folder (a link leads outside)"))
        self._clear(target.parent)
        there = ""
        if is_file(target) and not is_link(target):
            there = self.store.stat_cache.digest(target)
        if there == blob.digest:
            return
        source = self.store.blobs.verified_path(blob)
        if there and there != self.earlier.get(name) and not self._is_stored(target, there, blob.suffix):
            self.set_aside[name] = set_aside(target).relative_to(self.out).as_posix()
        try:
            copy_file(source, target)
        except StoreError:
            if not self.store.blobs.exists(blob):  # somebody has collected it meanwhile
                raise self.store.blobs.discard(blob, "is gone") from None
            raise
        self.written.append(name)

    def _is_stored(self, path: Path, digest: str, suffix: str) -> bool:
        return self.store.blobs.exists(BlobRef(digest, path.stat().st_size, suffix))


def _folders_of(name: str) -> list[str]:
    """Return the folders that a file is in, below the output folder."""
    return [str(folder) for folder in PurePosixPath(name).parents if folder.parts]


def _clash(what: str, other: str) -> str:
    return (f"{what} is delivered for {other} too. Rename one of the images or their folders, or, in the stage, put "
            "{item} or {name} into the names of the files")  # fmt: skip


def _is_inside(path: Path, folder: Path) -> bool:
    return resolved(path.parent).is_relative_to(resolved(folder))


def _cannot_write(path: Path, reason: str) -> str:
    return f"output {path} cannot be written: {reason}. Choose another folder with --out DIR, or free some space"
