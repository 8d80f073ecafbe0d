"""Copy the files of a run from the cache into the output folder; files that are up to date are not touched."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from pano_mvs.core.errors import ContractError, StoreError, UsageError
from pano_mvs.core.file_names import is_of_the_run
from pano_mvs.core.files import OUTPUT_MARK, clear_abandoned, is_full_disk, set_aside
from pano_mvs.core.paths import is_file, is_inside, is_link
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.scene import Files
from pano_mvs.scene.files import item_stems


class Owner(NamedTuple):
    """The unit that a file belongs to."""

    stage: str
    item: str


def folders_of(name: str) -> list[str]:
    """Return the folders of a file, inside the output folder."""
    return [str(folder) for folder in PurePosixPath(name).parents if folder.parts]


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
        self._owners: dict[str, Owner] = {}  # file to the unit that delivers it
        self._folders: dict[str, Owner] = {}  # folder to a unit that delivers a file below it
        self._stems: dict[str, str] = {}
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

    def begin_pass(self) -> None:
        """Start a new pass: what was published so far counts as that of an earlier run."""
        self._open()
        self.earlier |= self.published
        self.published = {}
        self._owners, self._folders = {}, {}

    def require_files(self) -> None:
        """Check that everything which this pass has published is still there.

        Raises:
            DamagedBlobError: if somebody has removed files; another pass writes them again.
        """
        lost = [name for name in (OUTPUT_MARK, *self.published) if not is_file(self.out / name)]
        if lost:
            raise DamagedBlobError(f"{self.out / lost[-1]} was removed during the run; writing it again")

    def publish(self, stage: str, item: str, ref: ItemRef, *, to: str = "") -> None:
        """Write the files of one unit, unless they exist with the right bytes.

        Args:
            to: folder for them inside the output folder.

        Raises:
            UsageError: if another unit writes one of the files; nothing is written.
            StoreError: if a file cannot be written.
            DamagedBlobError: if the copy in the cache is damaged.
            ContractError: if files of this unit clash with one another, or a file would replace one of the run itself;
                nothing is written.
        """
        files = self._placed_files(item, ref, to)
        self._claim(Owner(stage, item), files)
        for name, blob in files.items():
            self._write(name, blob)
            self.published[name] = blob.digest

    def _claim(self, owner: Owner, files: Iterable[str]) -> None:
        """Enter the files of a unit; raise UsageError if another unit writes one of them, or has a folder there."""
        for name in files:
            for path in (name, *folders_of(name)):
                self._require_own(path, owner, self._owners)
            self._require_own(name, owner, self._folders)
        for name in files:
            self._owners[name] = owner
            self._folders |= dict.fromkeys(folders_of(name), owner)

    @staticmethod
    def _require_own(path: str, owner: Owner, owners: Mapping[str, Owner]) -> None:
        other = owners.get(path, owner)
        if other.stage != owner.stage:
            raise UsageError(
                f"stages {other.stage!r} and {owner.stage!r} both write {path}; give one of them a folder of its own "
                "with `to: NAME`"
            )
        if other != owner:
            first, second = sorted((other.item, owner.item))
            raise UsageError(
                f"stage {owner.stage!r} delivers {path} for {first} and for {second}. Rename one of the "
                "images or their folders, or, in the stage, put {item} or {name} into the names of the files"
            )

    def _placed_files(self, item: str, ref: ItemRef, to: str) -> dict[str, BlobRef]:
        """Return the files of a unit by their path in the output folder, after checking these paths."""
        files: dict[str, BlobRef] = {}
        for target, blob in delivered_files(ref, self.store):
            name = self._placed(str(PurePosixPath(to) / target), item)
            if is_of_the_run(name):
                raise ContractError(
                    f"it delivers {name}, which the run itself writes: change the stage's name for the file, or give "
                    "it a folder with `to: NAME`"
                )
            if name in files:
                raise ContractError(f"it delivers {name} twice. Give each of its files a name of its own")
            files[name] = blob
        for name in files:
            if folder := next((folder for folder in folders_of(name) if folder in files), ""):
                raise ContractError(f"it delivers {folder} as a file and {name} inside of it. Rename one of them")
        return files

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
        is_ours = there in ("", self.earlier.get(name)) or self.store.blobs.exists(
            BlobRef(there, target.stat().st_size, blob.suffix)
        )
        if not is_ours:
            self.set_aside[name] = set_aside(target).relative_to(self.out).as_posix()
        self.store.blobs.copy(blob, target)
        self.written.append(name)


def delivered_files(ref: ItemRef, store: Store) -> list[tuple[str, BlobRef]]:
    """Return the target paths of a unit's files, and the blobs with their contents, without reading these.

    Raises:
        DamagedBlobError: if the stored list of the files is not valid.
    """
    try:
        meta = store.blobs.get(ref.parts["meta"])
        assert isinstance(meta, dict)
        files = [(target, ref.parts[str(number)]) for number, target in enumerate(meta["targets"])]
        Files({target: store.root for target, _ in files}).check()
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise DamagedBlobError(
            f"a cached list of files ({ref.digest}) is not valid ({error}); it is computed again"
        ) from error
    return files


def _cannot_write(path: Path, reason: str) -> str:
    return f"output {path} cannot be written: {reason}. Choose another folder with --out DIR, or free some space"
