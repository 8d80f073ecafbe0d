"""Items of a gather are loaded when they are asked for."""

from __future__ import annotations

import pytest

from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import ItemRef
from pano_mvs.engine.executors.execute import LazyMapping, max_kept_items


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
    assert max_kept_items([ref_of(1_000, 9_000), ref_of(10)]) == 12_800
    assert max_kept_items([ref_of(1_000), ref_of(10_000_000, 10_000_000)]) == 64
    assert max_kept_items([ref_of(*[200_000] * 100)]) == 6
