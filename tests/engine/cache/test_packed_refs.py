"""Packed references to blobs are those that were packed."""

from __future__ import annotations

import pytest

from pano_mvs.engine.cache.blobs import BlobRef, PackedRefs

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
