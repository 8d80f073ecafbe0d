"""Copy the files of a run from the cache into the output folder; files that are up to date are not touched."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

from pano_mvs.core.errors import ContractError, StoreError, UsageError
from pano_mvs.core.file_names import is_of_the_run
from pano_mvs.core.files import OUTPUT_MARK, clear_abandoned, is_full_disk, set_aside
from pano_mvs.core.paths import is_file, is_inside, is_link
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.scene import Files
from pano_mvs.scene.files import item_stems


class NameClashError(UsageError):
    """A unit would write the same file as another unit of its stage, or write a file twice."""

    def __init__(self, text: str, losers: Mapping[str, str] = MappingProxyType({})) -> None:
        # units of the same stage whose files were withdrawn because they clash with those of this unit: item to the
        # reason
        self.losers = losers
        super().__init__(text)


class Owner(NamedTuple):
    """The unit that a file belongs to."""

    stage: str
    item: str


class Claim(NamedTuple):
    """The result of a claim."""

    refusal: str  # why the unit cannot deliver its files; empty if it can
    losers: dict[str, str]  # units of the same stage that have to withdraw their files: item to the reason


class FileClaims:
    """The files that the units of one pass deliver, or would deliver if they did not clash with others.

    Of the units of a stage that claim the same file, the first one in the order of the capture gets it. The others
    deliver nothing, but their claims on other files still count, so that the result does not depend on the order in
    which claims are made.
    """

    def __init__(self, order: Callable[[Owner], tuple[int, str]]) -> None:
        """Start without claims; `order` returns the sort key of a unit."""
        self._order = order
        self._owners: dict[str, Owner] = {}  # file to the first unit that claims it, whether or not it delivers
        self._folders: set[str] = set()
        self._delivered: set[Owner] = set()
        self._lost: dict[Owner, tuple[str, ...]] = {}  # unit that cannot deliver to the files that it claims

    def claim(self, owner: Owner, files: Collection[str]) -> Claim:
        """Enter the files of a unit; call `deliver` once they are written.

        Raises:
            UsageError: if another stage writes one of the files.
        """
        claim = self._resolve(owner, files)
        for loser in claim.losers:
            other = Owner(owner.stage, loser)
            self._delivered.remove(other)
            self._lost[other] = tuple(name for name, found in self._owners.items() if found == other)
        for name in files:
            self._owners[name] = min(owner, self._owners.get(name, owner), key=self._order)
            self._folders.update(folders_of(name))
        if claim.refusal:
            self._lost[owner] = tuple(files)
        return claim

    def deliver(self, owner: Owner) -> None:
        """Record that the files of a unit have been written."""
        self._delivered.add(owner)

    def lost_files(self, owner: Owner) -> tuple[str, ...]:
        """Return the files that a unit claims but cannot deliver."""
        return self._lost[owner]

    def refusals(self) -> dict[tuple[str, str], str]:
        """Return why units could not deliver, independent of the order of claims: stage and item to the reason."""
        return {
            (owner.stage, owner.item): next(
                _reason(what, other.item)
                for what, other in self._clashes(owner, files)
                if self._order(other) < self._order(owner)
            )
            for owner, files in self._lost.items()
        }

    def _resolve(self, owner: Owner, files: Collection[str]) -> Claim:
        refusal, losers = "", {}
        for what, other in self._clashes(owner, files):
            if other.stage != owner.stage:
                raise UsageError(
                    f"stages {other.stage!r} and {owner.stage!r} both write {what}; give one of them a folder of its "
                    "own with `to: NAME`"
                )
            if self._order(owner) > self._order(other):
                refusal = refusal or _reason(what, other.item)
            elif other in self._delivered:
                losers[other.item] = _reason(what, owner.item)
        return Claim(refusal, losers)

    def _clashes(self, owner: Owner, files: Iterable[str]) -> Iterator[tuple[str, Owner]]:
        """Yield the clashes of some files: a description, and the other unit."""
        for name in files:
            if (other := self._owners.get(name)) is not None and other != owner:
                yield name, other
            for folder in folders_of(name):
                if (other := self._owners.get(folder)) is not None and other != owner:
                    yield f"{folder}, as a file and as a folder,", other
            if name in self._folders:
                inside = {other for path, other in self._owners.items() if path.startswith(f"{name}/")}
                yield from ((f"{name}, as a file and as a folder,", other) for other in sorted(inside - {owner}))


def folders_of(name: str) -> list[str]:
    """Return the folders of a file, inside the output folder."""
    return [str(folder) for folder in PurePosixPath(name).parents if folder.parts]


def _reason(what: str, other: str) -> str:
    return (
        f"{what} is delivered for {other} too. Rename one of the images or their folders, or, in the stage, put "
        "{item} or {name} into the names of the files"
    )


_PLACEHOLDER = re.compile(r"\{(?:item|name)\}")


class Publisher:
    """Writes the files of one run into one folder."""

    def __init__(self, out: Path, store: Store) -> None:
        """Create the folder if necessary, and check that it can be written.

        Raises:
            UsageError: if it cannot.
            StoreError: if its disk is full.
        """
        self.out = out
        self.store = store
        self.written: list[str] = []
        self.published: dict[str, str] = {}  # every file of the run, and its digest
        self.earlier: dict[str, str] = {}  # file to digest, as an earlier run or an earlier pass of this run wrote them
        # files of the user that were renamed to make room: original name to new name
        self.set_aside: dict[str, str] = {}
        self._claims = FileClaims(self._order)
        self._stems: dict[str, str] = {}
        self._ranks: dict[str, int] = {}
        self._open()
        self._cleared: set[Path] = set()
        self._patterns: set[tuple[str, str]] = set()  # what stands before and after the name of an image
        self._clear(out)

    def _open(self) -> None:
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            kind = StoreError if is_full_disk(error) else UsageError
            raise kind(_cannot_write(self.out, error.strerror or str(error))) from error
        if not os.access(self.out, os.W_OK | os.X_OK):
            raise UsageError(_cannot_write(self.out, "permission denied"))
        mark = self.out / OUTPUT_MARK
        try:
            if is_link(mark):
                mark.unlink()  # do not follow it
            mark.touch()
        except OSError as error:
            raise StoreError(_cannot_write(self.out, error.strerror or str(error))) from error

    def name_items(self, names: Iterable[str]) -> None:
        """Set the text for `{item}` for each image: its path without the extension, unless two images would collide."""
        self._stems = item_stems(names)
        self._ranks = {name: rank for rank, name in enumerate(self._stems)}

    def begin_pass(self) -> None:
        """Start a new pass: what was published so far counts as that of an earlier run."""
        self._open()
        self.earlier |= self.published
        self.published = {}
        self._claims = FileClaims(self._order)

    def require_files(self) -> None:
        """Check that everything which this pass has published is still there.

        Raises:
            DamagedBlobError: if somebody has removed files; another pass writes them again.
        """
        lost = [name for name in (OUTPUT_MARK, *self.published) if not is_file(self.out / name)]
        if lost:
            raise DamagedBlobError(f"{self.out / lost[-1]} was removed during the run; writing it again")

    def publish(self, stage: str, item: str, ref: ItemRef, *, to: str = "") -> Mapping[str, str]:
        """Write the files of one unit, unless they exist with the right bytes.

        If several units of a stage write the same file, only the one whose image comes first in the capture is
        published, and only if none of its files clashes with those of a unit before it. The result does not depend on
        the order in which the units are computed.

        Args:
            to: folder for them inside the output folder.

        Returns:
            Units of the same stage whose files were withdrawn because they clash with those of this unit: item to the
            reason.

        Raises:
            NameClashError: if files of this unit clash with one another, or with those of a unit that comes first;
                nothing is written.
            UsageError: if two stages write the same file.
            StoreError: if a file cannot be written.
            DamagedBlobError: if the copy in the cache is damaged.
            ContractError: if a file would replace one of the run itself; nothing is written.
        """
        owner = Owner(stage, item)
        files = self._placed_files(item, ref, to)
        refusal, losers = self._claims.claim(owner, files)
        for loser in losers:
            self._withdraw(self._claims.lost_files(Owner(stage, loser)))
        if refusal:
            raise NameClashError(refusal, losers)
        for name, blob in files.items():
            self._write(name, blob)
            self.published[name] = blob.digest
        self._claims.deliver(owner)
        return losers

    def refusals(self) -> dict[tuple[str, str], str]:
        """Return why units of this pass were not published: stage and item to the reason."""
        return self._claims.refusals()

    def _placed_files(self, item: str, ref: ItemRef, to: str) -> dict[str, BlobRef]:
        """Return the files of a unit by their path in the output folder, after checking these paths."""
        files: dict[str, BlobRef] = {}
        for target, blob in self._files(ref):
            name = self._placed(str(PurePosixPath(to) / target), item)
            if is_of_the_run(name):
                raise ContractError(
                    f"it delivers {name}, which the run itself writes: change the stage's name for the file, or give "
                    "it a folder with `to: NAME`"
                )
            if name in files:
                raise NameClashError(f"it delivers {name} twice. Give each of its files a name of its own")
            files[name] = blob
        for name in files:
            if folder := next((folder for folder in folders_of(name) if folder in files), ""):
                raise NameClashError(f"it delivers {folder} as a file and {name} inside of it. Rename one of them")
        return files

    def _order(self, owner: Owner) -> tuple[int, str]:
        return self._ranks.get(owner.item, len(self._ranks)), owner.item

    def _withdraw(self, files: Iterable[str]) -> None:
        for name in files:
            del self.published[name]
            with suppress(ValueError):
                self.written.remove(name)
            (self.out / name).unlink(missing_ok=True)
            self._remove_emptied([name])

    def remove_stale(self, earlier: dict[str, str], *, complete: bool = True) -> list[str]:
        """Delete files that an earlier run wrote and this one did not, if they are unchanged since then.

        Their folders are deleted too if they are empty; the output folder itself and links are kept.

        Args:
            earlier: file to digest.
            complete: whether this run has written all its files; otherwise, only those of images that are no longer in
                the capture are deleted.
        """
        removed: list[str] = []
        for name, digest in earlier.items():
            path = self.out / name
            if not complete and not self._is_of_gone_image(name):
                continue
            if name in self.published or not is_inside(path.parent, self.out) or not is_file(path):
                continue
            if self.store.stat_cache.digest(path) == digest:
                path.unlink()
                removed.append(name)
        self._remove_emptied(removed)
        return removed

    def _is_of_gone_image(self, name: str) -> bool:
        """Return whether a file is named like those of an image, but after no image of the capture."""
        texts = {*self._stems, *self._stems.values()}
        for before, after in self._patterns:
            middle = name[len(before) : len(name) - len(after)]
            if name == f"{before}{middle}{after}" and middle:
                folders_and_parts = {
                    middle[:end] for end in range(1, len(middle) + 1) if middle[end : end + 1] in "._/"
                }
                return not folders_and_parts & texts
        return False

    def _remove_emptied(self, removed: Iterable[str]) -> None:
        """Remove the folders of removed files if they are empty."""
        emptied = {folder for name in removed for folder in PurePosixPath(name).parents if folder.parts}
        for folder in sorted(emptied, key=lambda folder: len(folder.parts), reverse=True):
            path = self.out / folder
            if is_inside(path.parent, self.out) and not is_link(path):
                with suppress(OSError):  # it is not empty, or it is gone
                    path.rmdir()

    def _placed(self, target: str, item: str) -> str:
        texts = {"{item}": self._stems.get(item, item), "{name}": item}
        if len(parts := _PLACEHOLDER.split(target)) == 2:
            self._patterns.add((parts[0], parts[1]))
        return _PLACEHOLDER.sub(lambda match: texts[match[0]], target)

    def _files(self, ref: ItemRef) -> list[tuple[str, BlobRef]]:
        """Return the target paths of a unit's files, and the blobs with their contents, without reading these."""
        try:
            meta = self.store.blobs.get(ref.parts["meta"])
            assert isinstance(meta, dict)
            files = [(target, ref.parts[str(number)]) for number, target in enumerate(meta["targets"])]
            Files({target: self.out for target, _ in files}).check()
        except (KeyError, TypeError, ValueError, AssertionError) as error:
            raise DamagedBlobError(
                f"a cached list of files ({ref.digest}) is not valid ({error}); it is computed again"
            ) from error
        return files

    def _clear(self, folder: Path) -> None:
        """Remove temporary files of killed runs from a folder, once."""
        if folder not in self._cleared:
            self._cleared.add(folder)
            clear_abandoned(folder)

    def _write(self, name: str, blob: BlobRef) -> None:
        target = self.out / name
        if not is_inside(target.parent, self.out):
            raise StoreError(_cannot_write(target, "it would leave the output folder (a link leads outside)"))
        self._clear(target.parent)
        there = ""
        if is_file(target) and not is_link(target):
            there = self.store.stat_cache.digest(target)
        if there == blob.digest:
            return
        self.store.blobs.verified_place(blob)
        if there and there != self.earlier.get(name) and not self._is_stored(target, there, blob.suffix):
            self.set_aside[name] = set_aside(target).relative_to(self.out).as_posix()
        self.store.blobs.copy(blob, target)
        self.written.append(name)

    def _is_stored(self, path: Path, digest: str, suffix: str) -> bool:
        return self.store.blobs.exists(BlobRef(digest, path.stat().st_size, suffix))


def _cannot_write(path: Path, reason: str) -> str:
    return f"output {path} cannot be written: {reason}. Choose another folder with --out DIR, or free some space"
