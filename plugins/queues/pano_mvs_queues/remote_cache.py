"""Copy a cache to or from another place: a folder, SSH, or an object store, by fsspec.

Files of a cache are never changed, and their names state what they hold, so that a file of the same size is not copied
again, and an interrupted copy goes on with the same command. Only records grow when their results are dropped. What is
copied is checked against its digests first: blobs and packs by what they hold, records and lists of runs by the digest
in their first line. Values are copied before the records and the indexes that name them, so that a copy is a valid
cache at any time.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from pano_mvs.core.digest import IS_DIGEST
from pano_mvs.core.errors import PanoMvsError, StoreError, UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.files import CACHE_MARK, checked_body, read_regular, remove_whole, replacing
from pano_mvs.core.paths import below, is_file, is_link
from pano_mvs.engine.cache.blobs import FOLDER_DIGITS, SUFFIX, refuse_link
from pano_mvs.engine.cache.packs import RECORD, values_of
from pano_mvs.engine.cache.store import LAYOUT_VERSION, READ_LAYOUTS, Store, is_intact

Progress = Callable[[int, int], None]  # called with the bytes that are copied so far, and all bytes to copy
_AT_A_TIME = 8
_RUN_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
_ORDER = (
    re.compile(rf"blobs/(?P<folder>[0-9a-f]+)/(?P<name>{IS_DIGEST.pattern}){SUFFIX.pattern}"),
    re.compile(r"packs/[0-9a-f]{32}\.pack"),
    re.compile(r"packs/[0-9a-f]{32}\.index"),
    re.compile(rf"records/(?P<folder>[0-9a-f]+)/(?P<name>{IS_DIGEST.pattern})\.json"),
    re.compile(rf"(runs|pins)/{_RUN_NAME}\.json"),
)
"""The files of a cache that are copied, in this order."""

_MUTABLE = ("packs/*.index", "runs/*.json", "pins/*.json")


@dataclass(frozen=True, slots=True)
class Copied:
    """What was copied."""

    files: int
    size_bytes: int
    present: int  # number of files that were there already


class RemoteCache:
    """A cache behind a URL."""

    def __init__(self, url: str) -> None:
        """Open a place that fsspec knows, such as `s3://bucket/cache`, `ssh://host/cache` or a folder.

        Raises:
            UsageError: if fsspec or the library for this kind of URL is not installed, or the URL is not valid.
        """
        self.url = url
        fsspec = import_extra("fsspec.core", "copying a cache", "remote")
        try:
            self._files, self._root = fsspec.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
        except (ImportError, ValueError) as error:
            raise UsageError(f"{url}: {error}") from error
        self._made: set[str] = set()

    def push(self, store: Store, progress: Progress | None = None) -> Copied:
        """Copy what the remote cache lacks of a cache.

        Raises:
            StoreError: if a file of the cache is damaged, or the remote cache cannot be written.
            UsageError: if the remote cache has another layout.
        """
        layout, remote = self._layout(), self._listed()
        if layout is None:
            if remote:
                raise UsageError(f"{self.url} holds files but no cache: choose an empty place")
            self._attempt(lambda: self._write(CACHE_MARK, b""))
            self._attempt(lambda: self._write("layout.json", (store.root / "layout.json").read_bytes()))
        elif self._checked_layout(layout, store) < LAYOUT_VERSION:
            self._attempt(lambda: self._write("layout.json", (store.root / "layout.json").read_bytes()))
        local = _local_files(store)

        def copy(name: str) -> None:
            path = store.root / name
            if problem := _problem(name, path, index=path):
                raise StoreError(f"{path} {problem}, so that it was not copied. pano-mvs cache verify removes it")
            self._make_parent(name)
            self._files.put_file(str(path), self._path(name))

        def differs(name: str) -> bool:
            return _is_mutable(name) and self._attempt(lambda: self._read(name)) != (store.root / name).read_bytes()

        return self._copy(local, remote, copy, differs=differs, progress=progress)

    def pull(self, store: Store, progress: Progress | None = None) -> Copied:
        """Copy what a cache lacks of the remote cache.

        Raises:
            StoreError: if a file of the remote cache is damaged, or a file cannot be read or written.
            UsageError: if there is no cache, or one with another layout.
        """
        layout = self._layout()
        if layout is None:
            raise UsageError(f"{self.url} is not a cache: pano-mvs cache push makes one")
        if self._checked_layout(layout, store) == LAYOUT_VERSION:
            store.mark_layout()

        def copy(name: str) -> None:
            path = store.root / name
            refuse_link(path)
            with replacing(path, temporary_in=store.root / "tmp", durable=store.durable) as temporary:
                self._files.get_file(self._path(name), str(temporary))
                if problem := _problem(name, temporary, index=path):
                    if name.endswith(".index"):
                        remove_whole(path.with_suffix(".pack"))
                    raise StoreError(
                        f"{self.url}: {name} {problem}, so that it was not copied. Delete it there, and push it again"
                    )

        own = _local_files(store, unfinished=True)
        remote = {name: size for name, size in self._listed().items() if _belongs(name)}
        # What this cache has under a name that may change, such as an index without damaged values, stays.
        remote = {name: size for name, size in remote.items() if not (_is_mutable(name) and name in own)}
        return self._copy(remote, own, copy, differs=None, progress=progress)

    def _copy(
        self,
        wanted: Mapping[str, int],
        present: Mapping[str, int],
        copy: Callable[[str], None],
        *,
        differs: Callable[[str], bool] | None,
        progress: Progress | None,
    ) -> Copied:
        """Copy files in the order in which they refer to each other."""
        same = {name for name, size in wanted.items() if present.get(name) == size}
        if differs is not None:
            same -= {name for name in same if differs(name)}
        missing = [name for name in wanted if name not in same]
        total, done = sum(wanted[name] for name in missing), 0
        report = progress or (lambda _done, _total: None)
        report(0, total)
        with ThreadPoolExecutor(_AT_A_TIME) as pool:
            for pattern in _ORDER:
                names = iter([name for name in missing if pattern.fullmatch(name)])
                while several := list(islice(names, _AT_A_TIME)):
                    list(pool.map(lambda name: self._attempt(lambda: copy(name)), several))
                    done += sum(wanted[name] for name in several)
                    report(done, total)
        return Copied(len(missing), total, len(same))

    def _listed(self) -> dict[str, int]:
        """Return the files of the remote cache with their sizes."""
        root = self._root.rstrip("/")
        found: dict[str, dict[str, Any]] = self._attempt(lambda: self._files.find(root, detail=True))
        sizes = {path[len(root) :].lstrip("/"): int(info["size"] or 0) for path, info in found.items()}
        return {name: size for name, size in sizes.items() if any(pattern.fullmatch(name) for pattern in _ORDER)}

    def _layout(self) -> object:
        """Return what the remote cache says of its layout, or None if there is none."""
        if not self._attempt(lambda: self._files.isfile(self._path("layout.json"))):
            return None
        try:
            return json.loads(self._attempt(lambda: self._read("layout.json")))
        except ValueError as error:
            raise StoreError(f"{self.url}: layout.json is damaged. Delete it, and push again") from error

    def _checked_layout(self, layout: object, store: Store) -> int:
        """Return the layout of the remote cache, which a cache of this version can hold; raise UsageError otherwise."""
        version = layout.get("layout") if isinstance(layout, dict) else None
        if type(version) is not int or version not in READ_LAYOUTS:
            own = json.loads(read_regular(store.root / "layout.json"))
            raise UsageError(f"{self.url} has layout {layout!r}, but {store.root} has {own!r}: choose another place")
        return version

    def _attempt(self, action: Callable[[], Any]) -> Any:
        """Return the result of an action; libraries of object stores raise errors of many kinds."""
        try:
            return action()
        except PanoMvsError:
            raise
        except Exception as error:
            raise StoreError(f"{self.url}: {error or type(error).__name__}. The same command goes on") from error

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _read(self, name: str) -> bytes:
        return bytes(self._files.cat_file(self._path(name)))

    def _write(self, name: str, data: bytes) -> None:
        self._make_parent(name)
        self._files.pipe_file(self._path(name), data)

    def _make_parent(self, name: str) -> None:
        parent = str(PurePosixPath(self._path(name)).parent)
        if parent not in self._made:
            with suppress(FileExistsError):
                self._files.makedirs(parent, exist_ok=True)
            self._made.add(parent)


def _local_files(store: Store, *, unfinished: bool = False) -> dict[str, int]:
    """Return the files of a cache with their sizes, as far as they are copied; on request also packs without index."""
    found = {
        path.relative_to(store.root).as_posix(): path
        for folder in ("blobs", "records", "packs", "runs", "pins")
        for path in below(store.root / folder)
        if is_file(path) and not is_link(path)
    }
    left_out = set() if unfinished else set(store.blobs.packs.without_index())
    return {name: path.stat().st_size for name, path in found.items() if _belongs(name) and path not in left_out}


def _belongs(name: str) -> bool:
    """Return whether a file is one of a cache, and in the folder where it must be."""
    match = next(filter(None, (pattern.fullmatch(name) for pattern in _ORDER)), None)
    named = match.groupdict() if match else {}
    return match is not None and named.get("folder", "") == named.get("name", "")[:FOLDER_DIGITS]


def _is_mutable(name: str) -> bool:
    return any(PurePosixPath(name).match(pattern) for pattern in _MUTABLE)


def _problem(name: str, path: Path, *, index: Path) -> str:
    """Return what is wrong with a file of a cache; "" if it is intact.

    Args:
        path: the file, which may still have a temporary name.
        index: its own path, which is beside its pack if it is an index.
    """
    folder, stem = name.partition("/")[0], PurePosixPath(name).stem
    if folder in ("blobs", "records"):
        return "" if is_intact(path, stem, is_record=folder == "records") else "is damaged"
    if folder == "packs" and name.endswith(".index"):
        try:
            values = values_of(index.with_suffix(".pack"), path)
        except ValueError:
            return "is damaged"
        damaged = (v.digest for v in values if not is_intact(v, v.digest, is_record=v.kind == RECORD))
        return next((f"lists {digest}, which is damaged" for digest in damaged), "")
    if folder == "packs":
        return ""  # it is checked with its index, which is copied after it
    try:
        checked_body(read_regular(path))
    except ValueError:
        return "is damaged"
    return ""
