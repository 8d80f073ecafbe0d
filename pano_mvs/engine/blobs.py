"""Immutable content-addressed files: a blob's name is the digest of its bytes."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.core.digest import digest_from_bytes, digest_from_file
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import replacing
from pano_mvs.engine.stat_cache import StatCache
from pano_mvs.scene import FilePart, Part


class DamagedBlobError(StoreError):
    """A blob whose size or digest is not what its name promises; it has been removed, to be computed again."""


@dataclass(frozen=True, slots=True)
class BlobRef:
    """One stored part of a record.

    Attributes:
        digest: of the bytes.
        size_bytes: length.
        suffix: `.npy`, `.json`, or the native file's.
        external: whether the bytes are in a user's own file rather than in the store.
    """

    digest: str
    size_bytes: int
    suffix: str
    external: bool = False

    def to_json(self) -> list[Any]:
        """Return the reference as a JSON value."""
        return [self.digest, self.size_bytes, self.suffix, self.external]

    @staticmethod
    def from_json(value: list[Any]) -> BlobRef:
        """Return the reference that `to_json` gave."""
        digest, size_bytes, suffix, external = value
        return BlobRef(str(digest), int(size_bytes), str(suffix), bool(external))


class BlobStore:
    """A folder of blobs. External files are known by digest and found through the paths registered in this run."""

    def __init__(self, root: Path, stat_cache: StatCache) -> None:
        self.root = root
        self.temporary = root / "tmp"
        self.stat_cache = stat_cache
        self._external: dict[str, Path] = {}
        self._verified: set[str] = set()

    def register_external(self, path: Path) -> str:
        """Make a user's file findable by its digest, which is returned."""
        digest = self.stat_cache.digest(path)
        self._external[digest] = path
        return digest

    def path(self, ref: BlobRef) -> Path:
        """Return where a blob is or would be."""
        if ref.external:
            return self._external.get(ref.digest, Path("unregistered") / ref.digest)
        return self.root / "blobs" / ref.digest[:2] / f"{ref.digest}{ref.suffix}"

    def exists(self, ref: BlobRef) -> bool:
        """Return whether a blob is there with its right size (its bytes are checked when it is read)."""
        try:
            return self.path(ref).stat().st_size == ref.size_bytes
        except OSError:
            return False

    def put(self, part: Part) -> BlobRef:
        """Store one part of a record."""
        if isinstance(part, FilePart):
            return self._put_file(part)
        if isinstance(part, np.ndarray):
            return self._put_array(part)
        return self._put_bytes(
            json.dumps(part, sort_keys=True, separators=(",", ":"), allow_nan=False).encode(), ".json"
        )

    def get(self, ref: BlobRef) -> Part:
        """Return a stored part; arrays are memory-mapped.

        Raises:
            DamagedBlobError: if the bytes are not those that were stored; the blob is removed.
        """
        path = self.verified_path(ref)
        if ref.suffix == ".npy" and not ref.external:
            array: np.ndarray[Any, Any] = np.load(path, mmap_mode="r", allow_pickle=False)
            return array
        if ref.suffix == ".json" and not ref.external:
            value = json.loads(path.read_bytes())
            assert isinstance(value, dict)
            return value
        return FilePart(path, external=ref.external, digest=ref.digest)

    def verified_path(self, ref: BlobRef) -> Path:
        """Return a blob's path after checking its bytes, once in the life of this object."""
        path = self.path(ref)
        if ref.digest in self._verified:
            return path
        try:
            sound = path.stat().st_size == ref.size_bytes and digest_from_file(path) == ref.digest
        except OSError:
            sound = False
        if not sound:
            if not ref.external:
                path.unlink(missing_ok=True)
            raise DamagedBlobError(f"{path} is damaged or gone; the same command computes it again")
        self._verified.add(ref.digest)
        return path

    def _put_bytes(self, data: bytes, suffix: str) -> BlobRef:
        ref = BlobRef(digest_from_bytes(data), len(data), suffix)
        if not self.exists(ref):
            with replacing(self.path(ref), temporary_in=self.temporary) as temporary:
                temporary.write_bytes(data)
        return ref

    def _put_array(self, array: np.ndarray[Any, Any]) -> BlobRef:
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
        return self._put_bytes(buffer.getvalue(), ".npy")

    def _put_file(self, part: FilePart) -> BlobRef:
        suffix = part.path.suffix.lower()
        if part.external:
            digest = self.register_external(part.path)
            return BlobRef(digest, part.path.stat().st_size, suffix, external=True)
        ref = BlobRef(digest_from_file(part.path), part.path.stat().st_size, suffix)
        if not self.exists(ref):
            with replacing(self.path(ref), temporary_in=self.temporary) as temporary:
                shutil.copyfile(part.path, temporary)
        return ref
