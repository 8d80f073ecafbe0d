"""The folders of a cache: 4,096 for each kind of file."""

from __future__ import annotations

from pano_mvs.engine.cache.maintenance import collect, verify
from pano_mvs.engine.cache.store import Store
from tests.engine.conftest import Toy


def test_cache_keeps_to_its_layout(toy: Toy) -> None:
    root = toy.folder / "cache"
    assert toy.run().exit_code == 0
    assert {len(path.name) for name in ("records", "blobs") for path in (root / name).iterdir()} == {3}
    assert toy.run().computed == 0
    store = Store(root)
    damage = verify(store)
    assert damage.records == len(list((root / "records").rglob("*.json")))
    assert not damage.foreign
    found = collect(store, unused_s=-1, forget_after_s=-1)
    assert len(found.records) == damage.records
    assert len(found.blobs) == damage.blobs
