"""The base class of records: frozen dataclasses with an axis and a stored form."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import ChangedFileError, ContractError, InputError
from pano_mvs.core.paths import reason_of


class Axis(StrEnum):
    """What one item of a kind belongs to, which is also the unit of work on it."""

    ONE = "one"
    IMAGE = "image"
    PAIR = "pair"
    VIEW = "view"


@dataclass(frozen=True, slots=True)
class FilePart:
    """A native file that is part of a record.

    Attributes:
        external: True for a user's own file, of which the store only has the digest; False for a file that a stage
            wrote to its scratch folder, which the store takes over.
        digest: digest of the bytes, which the engine sets when it passes the part to a stage.
    """

    path: Path
    external: bool = False
    digest: str = ""

    def read_bytes(self) -> bytes:
        """Return the file's bytes; a user's own file must still have its `digest`.

        Raises:
            ChangedFileError: if a user's file has changed since the engine listed it.
            InputError: if the file cannot be read.
        """
        try:
            data = self.path.read_bytes()
        except (OSError, ValueError) as error:  # ValueError: an impossible file name
            raise InputError(
                f"{self.path}: cannot be read ({reason_of(error)}). Check that it exists and may be read"
            ) from error
        if self.external and self.digest and digest_from_bytes(data) != self.digest:
            raise ChangedFileError(changed_text(self.path), self.path)
        return data

    def read_text(self) -> str:
        """Return the file's text, in UTF-8 with or without a mark in front; raises as `read_bytes` does.

        Raises:
            InputError: if it is not such a text.
        """
        try:
            return self.read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: not a text file in UTF-8") from error

    def sha256(self) -> str:
        """Return the SHA-256 of the file's bytes in hex, as other programs state it; raises as `read_bytes` does."""
        return hashlib.sha256(self.read_bytes()).hexdigest()


def changed_text(path: Path) -> str:
    """Return the message about a user's file that changed after the run listed it."""
    return f"{path} changed during the run; run again to use it as it is now"


Part: TypeAlias = "NDArray[Any] | FilePart | dict[str, Any]"
Parts: TypeAlias = Mapping[str, Part]


def vanished_text(path: Path) -> str:
    """Return the message about a user's file that can no longer be read after the run listed it."""
    return f"{path} was removed during the run, or is no longer readable; restore it, or run again without it"


class Record:
    """Base of all kinds of values that pass between stages.

    A kind is a frozen dataclass that derives from this. Fields that hold an array are stored as .npy, files as they
    are, and all other fields together as one JSON part, `meta`. A kind that needs another form overrides `to_parts`
    and `from_parts`.

    Attributes:
        axis: what one item belongs to; None if it has the axis of the stage's input, as exported files.
        kind_version: raise it when the stored form changes, so that records of other versions are recomputed.
        explodes_into: the kind of a collection's items per image; see `explode`.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 1
    explodes_into: ClassVar[type[Record] | None] = None

    @classmethod
    def kind_name(cls) -> str:
        """Return the name under which the kind is shown and stored."""
        return cls.__name__

    def explode(self) -> Mapping[str, Record]:
        """Return the items of a collection by image name; each is stored and digested on its own."""
        return {}

    def doubted(self) -> Mapping[str, str]:
        """Return the doubtful images with the reason. A run with doubtful images ends with exit code 3.

        If a value is made from another value of its kind, its doubts replace those of the other.
        """
        return {}

    def loading_bytes(self) -> int:
        """Return the peak memory while the record's files are read, without the result.

        The engine adds it for each unit that reads the record; records are read one at a time.
        """
        return 0

    def check(self) -> None:
        """Raise ContractError if shapes, types or values are not what the kind promises."""

    def to_parts(self) -> Parts:
        """Return the record as named arrays, files and JSON objects."""
        parts: dict[str, Part] = {}
        meta: dict[str, Any] = {}
        for field in dataclasses.fields(self):  # type: ignore[arg-type]  # every kind is a dataclass
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray | FilePart):
                parts[field.name] = value
            else:
                meta[field.name] = value
        parts["meta"] = meta
        return parts

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record from the result of `to_parts`."""
        values: dict[str, Any] = {}
        fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]  # every kind is a dataclass
        for name, part in parts.items():
            if name == "meta":
                assert isinstance(part, dict)
                values.update({key: _tuples(value) for key, value in part.items() if key in fields})
            else:
                values[name] = part
        return cls(**values)


def _tuples(value: Any) -> Any:
    """Turn JSON's lists back into tuples, at any depth."""
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    return value


def require(condition: bool, kind: Record, what: str) -> None:
    """Raise ContractError naming the kind unless the condition holds."""
    if not condition:
        raise ContractError(f"{kind.kind_name()}: {what}")


def positions_fit(positions: NDArray[np.integer], count: int) -> bool:
    """Return whether all positions (N,), N > 0, are among `count` entries."""
    return bool(positions.min() >= 0 and positions.max() < count)


def require_array(
    kind: Record, name: str, *, dtype: type[np.generic], shape: tuple[int | None, ...], finite: bool = True
) -> NDArray[Any]:
    """Return the named field after checking that it is an array of that type and shape (None: any length)."""
    array = getattr(kind, name)
    require(isinstance(array, np.ndarray), kind, f"{name} must be an array, got {type(array).__name__}")
    require(array.dtype == dtype, kind, f"{name} must be {np.dtype(dtype).name}, got {array.dtype}")
    fits = len(array.shape) == len(shape) and all(b is None or a == b for a, b in zip(array.shape, shape, strict=True))
    require(fits, kind, f"{name} must have shape {shape}, got {array.shape}")
    if finite and np.issubdtype(array.dtype, np.floating):
        require(bool(np.isfinite(array).all()), kind, f"{name} holds NaN or infinite values")
    assert isinstance(array, np.ndarray)
    return array
