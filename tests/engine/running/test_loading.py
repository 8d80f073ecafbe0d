"""Inputs are read when they are used, and take no more memory than they need."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.execute import LazyMapping, max_kept_items
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.running.dispatcher import UnitMemory
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import SourceItem, spec_of
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.stages.features import sift_tangent
from pano_mvs.stages.source import FolderParams, folder
from tests.io.images.pictures import png_chunk

SiftParams = Registry.installed().stages["features.sift_tangent"].params_type


@pytest.fixture
def loaded() -> list[int]:
    return []


@pytest.fixture
def gather(loaded: list[int]) -> LazyMapping[str, int, list[int]]:
    def load(ref: int) -> list[int]:
        loaded.append(ref)
        return [ref]

    return LazyMapping({f"{idx:03d}": idx for idx in range(200)}, load)


def test_names_length_and_membership_load_nothing(gather: LazyMapping[str, int, list[int]], loaded: list[int]) -> None:
    assert list(gather) == [f"{idx:03d}" for idx in range(200)]
    assert len(gather) == 200
    assert "007" in gather
    assert "200" not in gather
    assert loaded == []


def test_it_is_a_mapping_with_the_items_in_order(gather: LazyMapping[str, int, list[int]]) -> None:
    assert dict(gather) == {f"{idx:03d}": [idx] for idx in range(200)}
    assert gather.get("200") is None
    with pytest.raises(KeyError, match="200"):
        gather["200"]


def test_what_was_asked_for_a_moment_ago_is_not_loaded_again(
    gather: LazyMapping[str, int, list[int]], loaded: list[int]
) -> None:
    for _ in range(3):
        assert gather["001"] is gather["001"]
    assert loaded == [1]


def test_only_the_latest_few_are_kept(gather: LazyMapping[str, int, list[int]], loaded: list[int]) -> None:
    for name in gather:
        gather[name], gather["000"]
    assert loaded == list(range(200))
    assert len(gather._latest) < 100
    gather["100"]
    assert loaded[-1] == 100


def test_a_failure_comes_out_of_the_access() -> None:
    def load(ref: object) -> None:
        raise OSError(f"no {ref}")

    with pytest.raises(OSError, match="no 1"):
        LazyMapping({"a": 1}, load)["a"]


def test_as_many_are_kept_as_are_asked_for(loaded: list[int]) -> None:
    def load(ref: int) -> list[int]:
        loaded.append(ref)
        return [ref]

    gather = LazyMapping({idx: idx for idx in range(5)}, load, max_kept=2)
    for key in (0, 1, 0, 2, 0, 1):
        gather[key]
    assert loaded == [0, 1, 2, 1]


def ref_of(*sizes: int) -> ItemRef:
    return ItemRef("kind", "d" * 32, {str(n): BlobRef("d" * 32, size, ".npy") for n, size in enumerate(sizes)})


def test_how_many_are_kept_depends_on_open_files_and_on_memory() -> None:
    assert max_kept_items([ref_of(1_000, 9_000), ref_of(10)], attrgetter("is_mapped")) == 12_800
    assert max_kept_items([ref_of(1_000), ref_of(10_000_000, 10_000_000)], attrgetter("is_mapped")) == 64
    assert max_kept_items([ref_of(*[200_000] * 100)], attrgetter("is_mapped")) == 6


GIB = 1 << 30


def unit_of(function: Any, params: Any, tmp_path: Path, *, memory: str = "0", **more: Any) -> tuple[UnitMemory, Unit]:
    spec = spec_of(function)
    assert spec is not None
    store = Store(tmp_path / "cache")
    entry = StageEntry("a", spec, params, Policy(use=spec.name, memory=memory), "w:1:1")
    inputs = {name: store.put_value(value) for name, value in more.pop("values", {}).items()}
    unit = Unit(entry, "x", ("x",), inputs, "0" * 32, {}, more.get("source"))
    return UnitMemory(store), unit


def stated(path: Path, width: int, height: int) -> Path:
    """A PNG of which no more than the header is there."""
    header = png_chunk(b"IHDR", width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0]))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + bytes(200_000))
    return path


@pytest.mark.parametrize(("width", "least", "most"), [(2048, 0, 0.02), (30_000, 3, 5), (60_000, 0, 0)])
def test_a_source_knows_the_decoded_size_by_the_header(tmp_path: Path, width: int, least: float, most: float) -> None:
    """A PNG of 30,000×15,000 took 2.8 GB without a word; what is beyond the limit is refused by name anyway."""
    item = SourceItem("x.png", {"image": stated(tmp_path / "x.png", width, width // 2)})
    memory, unit = unit_of(folder, FolderParams(path=tmp_path), tmp_path, source=item)
    assert least * GIB <= memory.of(unit) <= most * GIB


def panorama(tmp_path: Path, width: int, name: str) -> Panorama:
    (tmp_path / name).write_bytes(b"not read here")
    return Panorama(FilePart(tmp_path / name), (1024, 2048), (width // 2, width))


@pytest.mark.parametrize(
    ("width", "name", "least", "most"),
    [(8192, "x.jpg", 0, 0), (30_000, "x.jpg", 3, 4), (30_000, "x.tif", 7, 8)],
)
def test_stages_count_what_decoding_their_inputs_takes(
    tmp_path: Path, width: int, name: str, least: float, most: float
) -> None:
    memory, unit = unit_of(sift_tangent, SiftParams(), tmp_path, values={"image": panorama(tmp_path, width, name)})
    assert least * GIB <= memory.of(unit) <= most * GIB


def test_what_the_workflow_says_goes_first(tmp_path: Path) -> None:
    values = {"image": panorama(tmp_path, 30_000, "x.jpg")}
    memory, unit = unit_of(sift_tangent, SiftParams(), tmp_path, memory="1GB", values=values)
    assert memory.of(unit) == 10**9
