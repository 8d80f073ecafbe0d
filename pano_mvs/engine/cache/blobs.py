"""Immutable content-addressed files: the name of a blob is the digest of its bytes."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.digest import DIGEST_BYTES, IS_DIGEST, digest_from_bytes, digest_from_file
from pano_mvs.core.errors import ChangedFileError, StoreError
from pano_mvs.core.files import make_room, replacing
from pano_mvs.core.paths import is_folder, is_link
from pano_mvs.engine.cache.compression import MOST_STRIDE
from pano_mvs.engine.cache.packs import ARRAY, FILE, JSON, Packed, Packs
from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.scene import FilePart, Part
from pano_mvs.scene.record import changed_text

FOLDER_DIGITS = 3
"""Number of digits of a key or digest in the name of the folder of its file."""

SUFFIX = re.compile(r"(\.[a-z0-9_+-]{1,16})?")
_MOST_COMPONENTS = 4  # of points, normals, colours
_MAGIC = np.lib.format.magic(1, 0)


class DamagedBlobError(StoreError):
    """A blob whose size or digest does not match its name; it has been removed and will be computed again."""


@dataclass(frozen=True, slots=True)
class BlobRef:
    """One stored part of a record."""

    digest: str  # of the bytes
    size_bytes: int
    suffix: str  # `.npy`, `.json`, or that of the stored file
    external: bool = False  # whether the bytes are in a file of the user rather than in the cache

    def to_json(self) -> list[Any]:
        """Return the reference as a JSON value."""
        return [self.digest, self.size_bytes, self.suffix, self.external]

    @property
    def is_mapped(self) -> bool:
        """Whether the part is an array that is memory-mapped when it is loaded."""
        # Smaller arrays are read, which is faster than mapping them; a mapped array also keeps a file open.
        return self.suffix == ".npy" and not self.external and self.size_bytes >= (1 << 18)

    @staticmethod
    def from_json(value: list[Any]) -> BlobRef:
        """Return the reference from the result of `to_json`.

        Raises:
            ValueError: if the value is not a reference, as such a path could lead out of the cache.
        """
        digest, size_bytes, suffix, external = value
        is_valid = isinstance(digest, str) and IS_DIGEST.fullmatch(digest) and isinstance(suffix, str)
        if not is_valid or not SUFFIX.fullmatch(suffix) or type(size_bytes) is not int or type(external) is not bool:
            raise ValueError(f"not a reference to a blob: {value!r}")
        if not 0 <= size_bytes < (1 << 50):
            raise ValueError(f"a blob of {size_bytes} bytes")
        return BlobRef(digest, size_bytes, suffix, external)


class BlobStore:
    """A folder of blobs. External files are found by digest through the paths that were registered in this run.

    A new blob is a file. Arrays, JSON values, and files that can be compressed may be moved into packs later, even
    while they are in use.
    """

    def __init__(self, root: Path, stat_cache: StatCache, *, durable: bool = False) -> None:
        self.root = root
        self.packs = Packs(root)
        self.durable = durable
        self._folder = str(root / "blobs")
        self.temporary = root / "tmp"
        self.stat_cache = stat_cache
        self._external: dict[str, Path] = {}
        self._verified: set[BlobRef] = set()

    def register_external(self, path: Path) -> str:
        """Register a file of the user under its digest, which is returned."""
        digest = self.stat_cache.digest(path)
        self._external[digest] = path
        return digest

    def place_external(self, digest: str, path: Path) -> None:
        """Register a file of the user under a given digest, without reading the file."""
        self._external[digest] = path

    def path(self, ref: BlobRef) -> Path:
        """Return the path of a blob as a file, whether or not it exists."""
        return Path(self._place(ref))

    def place(self, ref: BlobRef) -> Path | Packed:
        """Return where a blob is: in a pack, or in a file, which may not exist."""
        return self._packed(ref) or self.path(ref)

    def _packed(self, ref: BlobRef, *, refresh: bool = False) -> Packed | None:
        found = None if ref.external else self.packs.find(ref.digest, refresh=refresh)
        if found is None or found.kind != (ref.suffix if ref.suffix in (ARRAY, JSON) else FILE):
            return None
        return found if found.is_compressed or found.size_bytes == ref.size_bytes else None

    def is_mapped(self, ref: BlobRef) -> bool:
        """Return whether a part is an array that is memory-mapped when it is loaded; compressed ones are not."""
        if not ref.is_mapped:
            return False
        found = self._packed(ref)
        return found is None or not found.is_compressed

    def stored_bytes(self, ref: BlobRef) -> int:
        """Return the size of a blob in the cache."""
        place = self.place(ref)
        return place.size_bytes if isinstance(place, Packed) else ref.size_bytes

    def _place(self, ref: BlobRef) -> str | Path:
        if ref.external:
            return self._external.get(ref.digest, f"unregistered/{ref.digest}")
        # A text, because creating a Path takes ten times as long.
        return f"{self._folder}/{ref.digest[:FOLDER_DIGITS]}/{ref.digest}{ref.suffix}"

    def exists(self, ref: BlobRef) -> bool:
        """Return whether a blob exists and has the right size; its bytes are checked when it is read."""
        if self._packed(ref) is not None:
            return True
        try:
            return os.stat(self._place(ref)).st_size == ref.size_bytes  # noqa: PTH116  # see `_place`
        except OSError:
            return self._packed(ref, refresh=True) is not None  # another process has moved it meanwhile

    def put(self, part: Part) -> BlobRef:
        """Store one part of a record."""
        if isinstance(part, FilePart):
            return self._put_file(part)
        if isinstance(part, np.ndarray):
            return self._put_array(part)
        data = json.dumps(part, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
        ref = BlobRef(digest_from_bytes(data), len(data), ".json")
        if not self._keep(ref):
            with self._writing(ref) as temporary:
                temporary.write_bytes(data)
        return ref

    def get(self, ref: BlobRef) -> Part:
        """Return a stored part; arrays are read-only, and large ones are memory-mapped.

        A file of the user is not read here: `FilePart.read_bytes` checks its bytes every time it reads them.

        Raises:
            DamagedBlobError: if the bytes are not those that were stored; the blob has been removed.
        """
        if ref.external:
            if not self.exists(ref):
                raise self.discard(ref, "is missing or changed")
            return FilePart(self.path(ref), external=True, digest=ref.digest)
        if (compressed := self._packed(ref)) is not None and compressed.is_compressed:
            return self._decompressed(ref, compressed)
        place = self.verified_place(ref)
        if isinstance(place, Packed) and (place.is_compressed or ref.suffix not in (ARRAY, JSON)):
            return self._decompressed(ref, place)  # another process has packed it meanwhile
        try:
            if ref.suffix == ARRAY:
                if not ref.is_mapped:
                    return _array(place.read_bytes())
                return _array(place.mapped() if isinstance(place, Packed) else np.memmap(place, np.uint8, "r"))
            if ref.suffix == JSON:
                value = json.loads(place.read_bytes())
                if not isinstance(value, dict):
                    raise ValueError("not an object")
                return value
        except FileNotFoundError as error:
            if self._packed(ref, refresh=True) not in (None, place):  # it was moved after it had been verified
                return self.get(ref)
            raise self.discard(ref, "is gone") from error
        except (ValueError, RecursionError) as error:
            raise self.discard(ref, f"has content that pano_mvs does not write ({error})") from error
        assert isinstance(place, Path)
        return FilePart(place, digest=ref.digest)

    def _decompressed(self, ref: BlobRef, place: Packed) -> Part:
        """Return a compressed array, or a file after it was stored as a file of its own."""
        try:
            if ref.suffix != ARRAY:
                self.verified_place(ref)
                with self._writing(ref) as temporary, temporary.open("wb") as stream:
                    place.write_to(stream)
                return FilePart(self.path(ref), digest=ref.digest)
            data = place.decompressed(ref.size_bytes)
            if ref not in self._verified and digest_from_bytes(data.data) != ref.digest:
                raise ValueError("not what was stored")
            self._verified.add(ref)
            return _array(data)
        except StoreError as error:  # it is damaged, the disk is full, or a run has merged packs meanwhile
            if self._packed(ref, refresh=True) not in (None, place):
                return self.get(ref)
            if isinstance(error, DamagedBlobError) or self.exists(ref):
                raise
            raise self.discard(ref, "is gone") from None  # garbage collection has deleted it meanwhile
        except FileNotFoundError as error:
            if self._packed(ref, refresh=True) not in (None, place):  # a run has merged packs meanwhile
                return self.get(ref)
            raise self.discard(ref, "is gone") from error
        except (OSError, ValueError) as error:
            raise self.discard(ref, f"is damaged ({error})") from error

    def copy(self, ref: BlobRef, target: Path) -> None:
        """Copy the bytes of a blob into a file, atomically.

        Raises:
            DamagedBlobError: if the bytes are not those that were stored; the blob has been removed.
            StoreError: if the file cannot be written.
        """
        place = self.verified_place(ref)
        try:
            with replacing(target) as temporary:
                if isinstance(place, Path):
                    shutil.copyfile(place, temporary)
                else:
                    with temporary.open("wb") as stream:
                        place.write_to(stream)
        except StoreError:
            if self._packed(ref, refresh=True) not in (None, place):  # it was moved after it had been verified
                self.copy(ref, target)
                return
            if self.exists(ref):
                raise
            raise self.discard(ref, "is missing") from None  # garbage collection has deleted it meanwhile

    def discard(self, ref: BlobRef, why: str) -> DamagedBlobError:
        """Remove an unusable blob, unless it is a file of the user, and return the error to raise."""
        place, path = self.place(ref), self.path(ref)
        if isinstance(place, Packed):
            self.packs.forget([place])
        if ref.external:
            self.stat_cache.forget(path)
        elif not is_link(path.parent):
            make_room(path)
        self._verified.discard(ref)
        name = place.name if isinstance(place, Packed) else path
        return DamagedBlobError(f"{name} {why}; the same command computes it again")

    def forget(self, ref: BlobRef) -> Path | Packed:
        """Return where a blob is that is about to be deleted, and check its bytes again if it is stored again."""
        self._verified.discard(ref)
        return self.place(ref)

    def verified_place(self, ref: BlobRef) -> Path | Packed:
        """Return where a blob is, after checking its bytes; this object checks each blob once."""
        place = self.place(ref)
        if ref in self._verified:
            return place
        if isinstance(place, Path) and not ref.external:
            refuse_link(place)
        while True:
            try:
                is_intact = _is_intact(place, ref)
                break
            except FileNotFoundError:
                moved = self._packed(ref, refresh=True)
                if moved in (None, place):
                    is_intact = False
                    break
                assert moved is not None
                place = moved  # by another process, in the meantime
            except OSError:
                is_intact = False
                break
        if not is_intact:
            raise self.discard(ref, "is damaged or missing")
        self._verified.add(ref)
        return place

    def _put_array(self, array: NDArray[Any]) -> BlobRef:
        """Store an array as .npy without a second copy of it in memory."""
        array = np.ascontiguousarray(array)
        buffer = io.BytesIO()
        np.lib.format.write_array_header_1_0(buffer, np.lib.format.header_data_from_array_1_0(array))
        header = buffer.getvalue()
        if array.dtype.hasobject:
            raise TypeError("an array of Python objects")
        data = array.reshape(-1).view(np.uint8).data if array.size else memoryview(b"")
        hasher = hashlib.blake2b(header, digest_size=DIGEST_BYTES)
        hasher.update(data)
        ref = BlobRef(hasher.hexdigest(), len(header) + array.nbytes, ".npy")
        if not self._keep(ref):
            with self._writing(ref) as temporary, temporary.open("wb") as stream:
                stream.write(header)
                stream.write(data)
        return ref

    def _put_file(self, part: FilePart) -> BlobRef:
        suffix = part.path.suffix.lower()
        if not SUFFIX.fullmatch(suffix):
            suffix = ""
        if part.external:
            digest = self.register_external(part.path)
            if part.digest and digest != part.digest:
                raise ChangedFileError(changed_text(part.path), part.path)
            return BlobRef(digest, part.path.stat().st_size, suffix, external=True)
        ref = BlobRef(digest_from_file(part.path), part.path.stat().st_size, suffix)
        if not self._keep(ref):
            with self._writing(ref) as temporary:
                shutil.copyfile(part.path, temporary)
        return ref

    def _keep(self, ref: BlobRef) -> bool:
        """Return whether an intact copy exists, and update its time stamp, so that garbage collection keeps it."""
        if not self.exists(ref):
            return False
        try:
            place = self.verified_place(ref)
            os.utime(place if isinstance(place, Path) else place.pack)
        except (DamagedBlobError, OSError):
            return False
        return True

    def _writing(self, ref: BlobRef) -> AbstractContextManager[Path]:
        path = self.path(ref)
        refuse_link(path)
        self._verified.discard(ref)  # it is missing or damaged
        if is_folder(path):
            make_room(path)
        return replacing(path, temporary_in=self.temporary, durable=self.durable)


def refuse_link(path: Path) -> None:
    """Raise StoreError if the folder of a file in a cache is a link, which caches do not have."""
    if is_link(path.parent):
        raise StoreError(
            f"{path.parent} is a link, but caches have no links: remove it, or choose another cache with --cache DIR"
        )


def _is_intact(place: Path | Packed, ref: BlobRef) -> bool:
    """Return whether the bytes are those that the reference names."""
    if isinstance(place, Packed):
        return place.content_digest() == ref.digest
    found = place.stat()
    return stat.S_ISREG(found.st_mode) and found.st_size == ref.size_bytes and digest_from_file(place) == ref.digest


def _array(data: bytes | NDArray[np.uint8]) -> NDArray[Any]:
    """Return the array in the bytes of a .npy file, read-only and without a copy; nothing in them is executed."""
    start = bytes(data[: len(_MAGIC) + 2])
    if not start.startswith(_MAGIC):
        return _other_format(bytes(data))
    begin = len(start) + int.from_bytes(start[len(_MAGIC) :], "little")
    shape, dtype, fortran_order = _header(bytes(data[len(_MAGIC) : begin]))
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - begin:
        raise ValueError(f"{len(data) - begin} bytes for an array of {shape}")
    try:
        if isinstance(data, bytes):
            values = np.frombuffer(data, dtype, count, begin) if count else np.zeros(0, dtype)
        else:
            values = data[begin:].view(dtype)  # an np.memmap stays one
        array = values.reshape(shape, order="F" if fortran_order else "C")
    except Exception as error:  # an impossible shape
        raise ValueError(str(error)) from error
    array.flags.writeable = False
    return array


def _other_format(data: bytes) -> NDArray[Any]:
    """Return the array in a .npy file of a format that this package does not write."""
    try:
        array: NDArray[Any] = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # numpy reads the header with Python's parser, which raises many kinds of errors
        raise ValueError(str(error)) from error
    array.flags.writeable = False
    return array


def element_bytes(stream: IO[bytes]) -> int:
    """Return the size of the numbers, or of the points and vectors, in a .npy file; 1 if it is not known."""
    start = stream.read(len(_MAGIC) + 2)
    if not start.startswith(_MAGIC):
        return 1
    try:
        length = start[len(_MAGIC) :]
        shape, dtype, fortran_order = _header(length + stream.read(int.from_bytes(length, "little")))
    except ValueError:
        return 1
    is_vector = len(shape) >= 2 and shape[-1] <= _MOST_COMPONENTS and not fortran_order
    size_bytes = dtype.itemsize * (max(1, shape[-1]) if is_vector else 1)
    return size_bytes if size_bytes <= MOST_STRIDE else 1


@lru_cache(maxsize=4096)
def _header(data: bytes) -> tuple[tuple[int, ...], np.dtype[Any], bool]:
    """Return shape, type and whether the order is Fortran's, from the header of a .npy file behind the magic.

    Raises:
        ValueError: if the header is not valid, or the array holds Python objects.
    """
    try:
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(io.BytesIO(data))
    except Exception as error:  # see `_other_format`
        raise ValueError(str(error)) from error
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    return shape, dtype, fortran_order


_SIZE_BYTES = 7  # blobs are smaller than 2⁵⁰ bytes
_PART_BYTES = DIGEST_BYTES + _SIZE_BYTES

Form: TypeAlias = "dict[str, tuple[int, str, bool]]"
"""Name of a part to its position, its suffix, and whether it is external."""

_forms: dict[tuple[tuple[str, str, bool], ...], Form] = {}


class PackedRefs(Mapping[str, BlobRef]):
    """References to blobs by name; equal to a dict with the same entries."""

    __slots__ = ("form", "packed")

    def __init__(self, parts: Mapping[str, BlobRef]) -> None:
        """Pack references; values with the same names and suffixes share these."""
        form = tuple((name, ref.suffix, ref.external) for name, ref in parts.items())
        if form not in _forms:
            _forms[form] = {name: (idx, suffix, external) for idx, (name, suffix, external) in enumerate(form)}
        self.form = _forms[form]  # what values with the same names and suffixes share
        self.packed = b"".join(
            bytes.fromhex(ref.digest) + ref.size_bytes.to_bytes(_SIZE_BYTES, "big") for ref in parts.values()
        )

    @staticmethod
    def from_packed(form: Form, packed: bytes) -> PackedRefs:
        """Return the references whose `form` and `packed` are known."""
        parts = PackedRefs.__new__(PackedRefs)
        parts.form, parts.packed = form, packed
        return parts

    def __getitem__(self, name: str) -> BlobRef:
        idx, suffix, external = self.form[name]
        start = idx * _PART_BYTES
        middle, end = start + DIGEST_BYTES, start + _PART_BYTES
        size_bytes = int.from_bytes(self.packed[middle:end], "big")
        return BlobRef(self.packed[start:middle].hex(), size_bytes, suffix, external)

    def __iter__(self) -> Iterator[str]:
        return iter(self.form)

    def __len__(self) -> int:
        return len(self.form)

    def __repr__(self) -> str:
        return repr(dict(self))
