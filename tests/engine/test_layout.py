"""The folders of a cache: 4,096 in new ones, 256 in those of earlier versions, which go on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pano_mvs.engine.cache.maintenance import collect, verify
from pano_mvs.engine.cache.store import Store
from tests.engine.conftest import Toy


def folder_names(root: Path) -> set[int]:
    return {len(path.name) for name in ("records", "blobs") for path in (root / name).iterdir()}


@pytest.mark.parametrize(("layout", "digits"), [(None, 3), (1, 2), (2, 3)])
def test_cache_keeps_to_its_layout(toy: Toy, layout: int | None, digits: int) -> None:
    root = toy.folder / "cache"
    if layout is not None:
        root.mkdir()
        (root / "layout.json").write_text(json.dumps({"layout": layout}))
    assert toy.run().exit_code == 0
    assert folder_names(root) == {digits}
    assert toy.run().computed == 0
    store = Store(root)
    damage = verify(store)
    assert damage.records == len(list((root / "records").rglob("*.json")))
    assert not damage.foreign
    found = collect(store, unused_s=-1, forget_after_s=-1)
    assert len(found.records) == damage.records
    assert len(found.blobs) == damage.blobs
