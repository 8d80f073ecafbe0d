"""Packs: the bytes of many records, arrays, JSON values and files in one file, so that large captures take few files.

A pack is `packs/<name>.pack`, with one value after the other, each at a multiple of 64 bytes, so that arrays can be
memory-mapped. `packs/<name>.index` lists them, below a digest of the list; it is written after the pack, so a pack
without an index is the rest of a process that was killed. Both get their names by renaming. A pack is never changed;
to remove a value, its index is replaced by one without the value.

Arrays and files are compressed where that pays (`pano_mvs.engine.cache.compression`), and arrays that are larger than
`MAX_COMPRESSED_BYTES` are not, so that they can be memory-mapped and need not fit into memory.
"""

from __future__ import annotations

import hashlib
import os
import stat
import uuid
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.digest import DIGEST_BYTES
from pano_mvs.core.files import checked_body, read_regular, remove_whole, replacing, write_checked
from pano_mvs.core.paths import children, is_file, is_link
from pano_mvs.engine.cache.compression import Shuffle, compress, decompress, decompressed_chunks

RECORD, ARRAY, JSON, FILE = "record", ".npy", ".json", "file"
_KINDS = ((RECORD, False), (ARRAY, False), (JSON, False), (ARRAY, True), (FILE, True))
"""The kinds of values by their number in an index, and whether they are compressed."""

DAMAGED = "damaged"  # no digest
MIN_COMPRESSED_BYTES = 4096
MAX_COMPRESSED_BYTES = 128_000_000
_ENTRY = np.dtype(
    [("high", ">u8"), ("low", ">u8"), ("offset", "<u8"), ("size", "<u8"), ("time", "<f8"), ("kind", "u1")]
)
_NO_ENTRIES = np.zeros(0, _ENTRY)  # of an index that cannot be read
_TABLE = np.dtype([("high", "u8"), ("low", "u8"), ("offset", "u8"), ("size", "u8"), ("pack", "u4"), ("kind", "u1")])


class Packed(NamedTuple):  # created for each value that is looked up, four times as fast as a frozen dataclass
    """One value in a pack."""

    pack: Path
    offset: int
    size_bytes: int
    digest: str  # of a blob, or the key of a record
    kind: str  # `RECORD`, `ARRAY`, `JSON` or `FILE`
    time_s: float = 0.0  # when it was stored, in seconds since the epoch; 0 where this was not asked for
    is_compressed: bool = False  # `size_bytes` is then the compressed size
    shuffle: Shuffle = Shuffle()  # of a value that is to be compressed

    @property
    def name(self) -> str:
        """The pack and the name of the value in it, for messages."""
        suffix = {RECORD: ".json", FILE: ""}.get(self.kind, self.kind)
        return f"{self.pack}:{self.digest}{suffix}"

    def read_bytes(self) -> bytes:
        """Return the bytes as they are stored; fewer if the pack has been cut.

        Raises:
            OSError: if the pack cannot be read.
        """
        with _opened(self.pack) as stream:
            stream.seek(self.offset)
            return stream.read(self.size_bytes)

    def decompressed(self, size_bytes: int) -> NDArray[np.uint8]:
        """Return the bytes of a compressed value of which the size is known.

        Raises:
            OSError: if the pack cannot be read.
            ValueError: if the value is damaged.
        """
        with _opened(self.pack) as stream:
            stream.seek(self.offset)
            return decompress(stream, self.size_bytes, size_bytes)

    def write_to(self, target: IO[bytes]) -> None:
        """Write the bytes of the value into a file, of which only a part is in memory at a time.

        Raises:
            OSError: if the pack cannot be read.
            ValueError: if the value is damaged.
        """
        with _opened(self.pack) as stream:
            if not self.is_compressed:
                _copy(stream, self, target.write)
                return
            stream.seek(self.offset)
            for chunk in decompressed_chunks(stream, self.size_bytes):
                target.write(chunk.data)

    def mapped(self) -> NDArray[np.uint8]:
        """Return the bytes memory-mapped and read-only.

        Raises:
            OSError, ValueError: if the pack cannot be mapped.
        """
        return np.memmap(self.pack, np.uint8, "r", self.offset, (self.size_bytes,))

    def content_digest(self) -> str:
        """Return the digest of the value, of which only a part is in memory at a time.

        That of a value that cannot be decompressed is `DAMAGED`.

        Raises:
            OSError: if the pack cannot be read.
        """
        hasher = hashlib.blake2b(digest_size=DIGEST_BYTES)
        with _opened(self.pack) as stream:
            if not self.is_compressed:
                _copy(stream, self, hasher.update)
                return hasher.hexdigest()
            stream.seek(self.offset)
            try:
                for chunk in decompressed_chunks(stream, self.size_bytes):
                    hasher.update(chunk.data)
            except ValueError:
                return DAMAGED
        return hasher.hexdigest()


class Packs:
    """The packs of one cache."""

    def __init__(self, root: Path) -> None:
        self.folder = root / "packs"
        self._temporary = root / "tmp"
        self._indexes: dict[Path, tuple[tuple[int, ...], NDArray[Any]]] = {}
        # The packs, the table, and its first halves of digests: a view of contiguous ones, which is searched fastest.
        self._sorted: tuple[list[Path], NDArray[Any], memoryview] = [], np.zeros(0, _TABLE), memoryview(b"")
        self._seen_ns = -1

    def find(self, digest: str, *, refresh: bool = False) -> Packed | None:
        """Return a value, or None if no pack holds it.

        Args:
            digest: of a blob, or the key of a record.
            refresh: list the folder again, which other processes may have changed, even if its time stamp is the same.
        """
        self._refresh(force=refresh)
        packs, table, highs = self._sorted
        high, low = _halves(digest)
        for row in range(bisect_left(highs, high), len(table)):
            found_high, found_low, offset, size, pack, kind = table[row].item()
            if found_high != high:
                break
            if found_low == low:
                name, is_compressed = _KINDS[kind]
                return Packed(packs[pack], offset, size, digest, name, is_compressed=is_compressed)
        return None

    def each(self) -> Iterator[Packed]:
        """Yield every value, pack after pack."""
        self._refresh(force=True)
        for pack, (_, entries) in sorted(self._indexes.items()):
            yield from _values(pack, entries)

    def forget(self, lost: Iterable[Packed]) -> None:
        """Take values out of the indexes of their packs; their bytes stay until `rewrite`.

        Raises:
            StoreError: if an index cannot be replaced.
        """
        by_pack: dict[Path, set[int]] = {}
        for packed in lost:
            by_pack.setdefault(packed.pack, set()).add(packed.offset)
        self._refresh(force=True)
        for pack, offsets in by_pack.items():
            if pack in self._indexes and is_file(pack):
                entries = self._indexes[pack][1]
                self._write_index(pack, entries[~np.isin(entries["offset"], list(offsets))])
        self._refresh(force=True)

    def add(self, values: Iterable[tuple[Packed, Path | None]]) -> None:
        """Write values into new packs; when this returns, they are on the disk and found.

        Args:
            values: each with the file that holds it; None if it is in the pack that it names.

        Raises:
            StoreError: if the disk is full, or the folder cannot be written.
        """
        waiting = iter(values)
        following = next(waiting, None)
        while following is not None:
            pack = self.folder / f"{uuid.uuid4().hex}.pack"
            entries: list[tuple[int, int, int, int, float, int]] = []
            with replacing(pack, temporary_in=self._temporary, durable=True) as temporary, temporary.open("wb") as out:
                # Collection rewrites a pack as a whole, and needs this much free space.
                while following is not None and (not entries or out.tell() < (1 << 30)):
                    value, path = following
                    out.write(bytes(-out.tell() % 64))  # the alignment of arrays in memory, and so of .npy headers
                    offset = out.tell()
                    if (stored := _stored(value, path, out)) is not None:
                        used_s = max(value.time_s, _mtime(value.pack) if path is None else 0.0)
                        size_bytes, is_compressed = stored
                        kind = _KINDS.index((value.kind, is_compressed))
                        entries.append((*_halves(value.digest), offset, size_bytes, used_s, kind))
                    else:
                        out.seek(offset)
                        out.truncate()
                    following = next(waiting, None)
            newest = max((used_s for *_, used_s, _ in entries), default=0.0)
            os.utime(pack, (newest, newest))
            self._write_index(pack, np.array(entries, _ENTRY))
        self._refresh(force=True)

    def rewrite(self, packs: Iterable[Path]) -> None:
        """Replace packs by new ones with only what their indexes still list.

        Raises:
            StoreError: if a pack cannot be read, written or removed.
        """
        self._refresh(force=True)
        old = [pack for pack in packs if pack in self._indexes]
        self.add((value, None) for pack in old for value in _values(pack, self._indexes[pack][1]))
        for pack in old:
            self.remove(pack)

    def remove(self, pack: Path) -> None:
        """Remove a pack with its index, and all values in it."""
        if not is_link(pack.parent):
            remove_whole(pack.with_suffix(".index"))
            remove_whole(pack)  # Windows keeps a file that is mapped; a later collection removes it

    def times(self) -> dict[Path, float]:
        """Return when each pack was last used, in seconds since the epoch."""
        self._refresh(force=True)
        return {pack: _mtime(pack) for pack in self._indexes}

    def damaged_indexes(self) -> list[Path]:
        """Return the indexes that cannot be read; what their packs hold is lost."""
        self._refresh(force=True)
        return [pack.with_suffix(".index") for pack, (_, entries) in self._indexes.items() if entries is _NO_ENTRIES]

    def without_index(self) -> list[Path]:
        """Return the packs of processes that were killed before they had written the index."""
        self._refresh(force=True)
        return [pack for pack in children(self.folder, "*.pack") if pack not in self._indexes]

    def _write_index(self, pack: Path, entries: NDArray[Any]) -> None:
        if not len(entries):  # collection finds packs by their values
            self.remove(pack)
            return
        write_checked(pack.with_suffix(".index"), entries.tobytes(), temporary_in=self._temporary, durable=True)

    def _refresh(self, *, force: bool) -> None:
        """Read the indexes that other processes have written or replaced since the last time."""
        while force or _changed_ns(self.folder) != self._seen_ns:
            self._seen_ns = _changed_ns(self.folder)
            # A listing may miss a new index although it lists an old one that the new one has replaced since.
            force = not self._read_indexes()

    def _read_indexes(self) -> bool:
        """Read the indexes that were written or replaced since the last time; return False if one has vanished."""
        found: dict[Path, tuple[tuple[int, ...], NDArray[Any]]] = {}
        for path in children(self.folder, "*.index"):
            pack = path.with_suffix(".pack")
            state, known = _state(path), self._indexes.get(pack)
            if known is not None and known[0] == state:
                found[pack] = known
                continue
            entries = _read_index(path)
            if entries is None and not _state(path):
                return False
            found[pack] = state, _NO_ENTRIES if entries is None else entries
        if found.keys() != self._indexes.keys() or any(found[pack] is not self._indexes[pack] for pack in found):
            self._indexes = found
            table = _table([found[pack][1] for pack in sorted(found)])
            self._sorted = sorted(found), table, table["high"].copy().data
        return True


def values_of(pack: Path, index: Path) -> Iterator[Packed]:
    """Return the values of a pack by an index, which may be in another place.

    Raises:
        ValueError: if the index is damaged.
    """
    entries = _read_index(index)
    if entries is None:
        raise ValueError(f"{index} is damaged")
    return _values(pack, entries)


def _values(pack: Path, entries: NDArray[Any]) -> Iterator[Packed]:
    for high, low, offset, size, time_s, kind in entries.tolist():
        name, is_compressed = _KINDS[kind]
        yield Packed(pack, offset, size, f"{high:016x}{low:016x}", name, time_s, is_compressed)


def _table(indexes: list[NDArray[Any]]) -> NDArray[Any]:
    """Return the entries of all packs, sorted by the first half of the digest."""
    table = np.zeros(sum(map(len, indexes)), _TABLE)
    for name in ("high", "low", "offset", "size", "kind"):
        table[name] = np.concatenate([np.zeros(0, _ENTRY), *indexes])[name]
    table["pack"] = np.repeat(np.arange(len(indexes)), [len(entries) for entries in indexes])
    return table[np.argsort(table["high"], kind="stable")]


def _read_index(path: Path) -> NDArray[Any] | None:
    """Return the entries of an index, or None if it is damaged."""
    try:
        entries = np.frombuffer(checked_body(read_regular(path)), _ENTRY)
    except (OSError, ValueError):
        return None
    return entries if (entries["kind"] < len(_KINDS)).all() else None


def _stored(value: Packed, path: Path | None, out: IO[bytes]) -> tuple[int, bool] | None:
    """Append a value to a pack, compressed if that pays.

    Returns:
        The size in the pack and whether it is compressed; None if the value is gone, or has another length.
    """
    try:
        if path is None:
            with _opened(value.pack) as stream:
                is_whole = _copy(stream, value, out.write) == value.size_bytes
                return (value.size_bytes, value.is_compressed) if is_whole else None
        with _opened(path) as stream:
            if is_compressible(value.kind, value.size_bytes) and _length(stream) == value.size_bytes:
                stored = compress(stream, value.size_bytes, out, shuffle=value.shuffle)
                if stored or value.kind == FILE:
                    return (stored, True) if stored else None
            is_whole = _copy(stream, Packed(path, 0, value.size_bytes + 1, "", ""), out.write) == value.size_bytes
            return (value.size_bytes, False) if is_whole else None
    except (FileNotFoundError, EOFError):
        return None


def is_compressible(kind: str, size_bytes: int) -> bool:
    """Return whether a value is compressed if that pays."""
    return kind == FILE or (kind == ARRAY and MIN_COMPRESSED_BYTES <= size_bytes <= MAX_COMPRESSED_BYTES)


def _length(stream: IO[bytes]) -> int:
    """Return the size of an open file, which is then at its beginning."""
    stream.seek(0, os.SEEK_END)
    size_bytes = stream.tell()
    stream.seek(0)
    return size_bytes


def _copy(stream: IO[bytes], value: Packed, write: Callable[[bytes], object]) -> int:
    stream.seek(value.offset)
    left = value.size_bytes
    while left and (chunk := stream.read(min(left, 1 << 20))):
        write(chunk)
        left -= len(chunk)
    return value.size_bytes - left


def _opened(path: Path) -> IO[bytes]:
    """Open a regular file; opening a FIFO would wait for ever."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise FileNotFoundError(f"{path} is not a regular file")
    return path.open("rb")


def _halves(digest: str) -> tuple[int, int]:
    return int(digest[:DIGEST_BYTES], 16), int(digest[DIGEST_BYTES:], 16)


def _changed_ns(folder: Path) -> int:
    try:
        return os.stat(folder).st_mtime_ns  # noqa: PTH116  # called for every value that is looked up
    except OSError:
        return 0


def _state(path: Path) -> tuple[int, ...]:
    try:
        found = path.lstat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _mtime(path: Path) -> float:
    try:
        return path.lstat().st_mtime
    except OSError:
        return 0.0
