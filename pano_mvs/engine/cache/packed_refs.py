"""References to the parts of a stored value, in a fifth of the memory: a run may hold a million of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias

from pano_mvs.core.digest import DIGEST_BYTES
from pano_mvs.engine.cache.blobs import BlobRef

_SIZE_BYTES = 7  # blobs are smaller than 2⁵⁰ bytes
_PART_BYTES = DIGEST_BYTES + _SIZE_BYTES

_Form: TypeAlias = "dict[str, tuple[int, str, bool]]"
"""Name of a part to its position, its suffix, and whether it is external."""

_forms: dict[tuple[tuple[str, str, bool], ...], _Form] = {}


class PackedRefs(Mapping[str, BlobRef]):
    """References to blobs by name; equal to a dict with the same entries."""

    __slots__ = ("_form", "_packed")

    def __init__(self, parts: Mapping[str, BlobRef]) -> None:
        """Pack references; values with the same names and suffixes share these."""
        form = tuple((name, ref.suffix, ref.external) for name, ref in parts.items())
        if form not in _forms:
            _forms[form] = {name: (idx, suffix, external) for idx, (name, suffix, external) in enumerate(form)}
        self._form = _forms[form]
        self._packed = b"".join(
            bytes.fromhex(ref.digest) + ref.size_bytes.to_bytes(_SIZE_BYTES, "big") for ref in parts.values()
        )

    def __getitem__(self, name: str) -> BlobRef:
        """Return one reference."""
        idx, suffix, external = self._form[name]
        start = idx * _PART_BYTES
        middle, end = start + DIGEST_BYTES, start + _PART_BYTES
        size_bytes = int.from_bytes(self._packed[middle:end], "big")
        return BlobRef(self._packed[start:middle].hex(), size_bytes, suffix, external)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._form)

    def __len__(self) -> int:
        """Return the number of parts."""
        return len(self._form)

    def __repr__(self) -> str:
        """Return the references as a dict prints them."""
        return repr(dict(self))
