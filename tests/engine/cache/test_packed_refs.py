"""Packed references to blobs are those that were packed."""

from __future__ import annotations

import pytest

from pano_mvs.engine.cache.blobs import BlobRef, PackedRefs
from pano_mvs.engine.cache.store import ItemRef

PARTS = {
    "meta": BlobRef("0" * 32, 0, ".json"),
    "image": BlobRef("f0" * 16, 123, ".jpg", external=True),
    "array": BlobRef("0123456789abcdef" * 2, (1 << 50) - 1, ".npy"),
    "0": BlobRef("1" * 32, 255, ""),
}


@pytest.mark.parametrize("names", [[], ["array"], list(PARTS), list(reversed(PARTS))])
def test_packed_references_equal_a_dict_of_the_same(names: list[str]) -> None:
    parts = {name: PARTS[name] for name in names}
    packed = PackedRefs(parts)
    assert list(packed.items()) == list(parts.items())
    assert packed == parts
    assert parts == packed
    assert packed == PackedRefs(parts)
    assert repr(packed) == repr(parts)


def test_packed_references_differ_in_any_field() -> None:
    packed = PackedRefs(PARTS)
    for name, ref in PARTS.items():
        others = [
            BlobRef("2" * 32, ref.size_bytes, ref.suffix, ref.external),
            BlobRef(ref.digest, ref.size_bytes ^ 1, ref.suffix, ref.external),
            BlobRef(ref.digest, ref.size_bytes, ".other", ref.external),
            BlobRef(ref.digest, ref.size_bytes, ref.suffix, not ref.external),
        ]
        assert all(packed != PackedRefs(PARTS | {name: other}) for other in others)
    with pytest.raises(KeyError, match="nothing"):
        packed["nothing"]


def test_a_reference_has_what_it_was_made_of() -> None:
    ref = ItemRef("Kind", "0f" * 16, PARTS)
    assert (ref.kind, ref.digest, dict(ref.parts)) == ("Kind", "0f" * 16, PARTS)
    assert ref == ItemRef.from_json(ref.to_json())
    assert ref == ItemRef("Kind", "0f" * 16, dict(reversed(PARTS.items())))
    others = ItemRef("Other", "0f" * 16, PARTS), ItemRef("Kind", "00" * 16, PARTS), ItemRef("Kind", "0f" * 16, {})
    assert all(ref != other for other in (*others, "Kind"))
    assert repr(ref).startswith("ItemRef(kind='Kind', digest='0f0f")
    for wrong in ("", "0f", "0F" * 16, "0f" * 17, "none" * 8):
        with pytest.raises(ValueError, match="not a digest"):
            ItemRef("Kind", wrong, PARTS)
