"""Pair selectors for large sets: by place, by looks, where a walk closes; and the glance that saves matching."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.pair_selection import (
    automatic_pairs,
    east_north_m,
    exhaustive_pairs,
    loop_closing_pairs,
    most_pairs,
    nearest_links,
    position_pairs,
    retrieval_pairs,
    sample_matches,
    sequential_pairs,
)
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import GlobalDescriptor
from tests.algorithms.features.test_matching import features
from tests.algorithms.poses.synthetic_path import SIGHT, PathCapture, path_capture


@pytest.fixture(scope="module")
def walk() -> PathCapture:
    return path_capture(np.random.default_rng(1), 40, keypoints=300, described=True)


@pytest.fixture(scope="module")
def looks(walk: PathCapture) -> dict[str, GlobalDescriptor]:
    return {name: vlad_descriptor(found) for name, found in walk.features.items()}


def groups(names: Iterable[Any], pairs: Iterable[Sequence[Any]]) -> int:
    """Number of groups of images that hang together."""
    group = {name: {name} for name in names}
    for a, b in pairs:
        joined = group[a] | group[b]
        group.update(dict.fromkeys(joined, joined))
    return len({id(members) for members in group.values()})


def test_position_pairs_are_the_nearest_of_either() -> None:
    rng = np.random.default_rng(2)
    names = [f"{n}" for n in range(30)]
    places = {name: rng.normal(size=3) for name in names}
    pairs = position_pairs(names, places, neighbours=4)
    pairs.check()
    near: set[tuple[str, ...]] = set()
    for a in names:
        others = sorted((b for b in names if b != a), key=lambda b: np.linalg.norm(places[a] - places[b]))
        near |= {tuple(sorted((a, b), key=names.index)) for b in others[:4]}
    assert near <= set(pairs.pairs)
    assert len(set(pairs.pairs) - near) == groups(names, near) - 1


def test_groups_that_would_be_apart_are_joined_by_the_shortest_link() -> None:
    places = {name: np.array([x, 0.0]) for name, x in (("a", 0), ("b", 1), ("c", 10), ("d", 11.5))}
    pairs = position_pairs(list(places), places, neighbours=1)
    assert pairs.pairs == (("a", "b"), ("b", "c"), ("c", "d"))


def test_images_at_one_place_hang_together_too() -> None:
    places = {f"{n}": np.zeros(2) for n in range(12)}
    pairs = position_pairs(list(places), places, neighbours=2)
    assert groups(places, pairs.pairs) == 1


def test_an_image_without_position_has_its_neighbours_in_the_order() -> None:
    names = [f"{n}" for n in range(8)]
    places = {name: np.array([100.0 * int(name), 0]) for name in names if name != "3"}
    pairs = position_pairs(names, places, neighbours=1, window=2).pairs
    assert {pair for pair in pairs if "3" in pair} == {("1", "3"), ("2", "3"), ("3", "4"), ("3", "5")}
    assert set(position_pairs(names, {}, neighbours=1, window=2).pairs) == set(sequential_pairs(names, window=2).pairs)


def test_metres_east_and_north() -> None:
    """A thousandth of a degree of latitude is 110.6 to 111.7 m; heights do not count."""
    at = east_north_m([(60.0, 10.0, 0.0), (60.001, 10.0, 500.0), (60.0, 10.001, -20.0)])
    north, east = at[1] - at[0], at[2] - at[0]
    np.testing.assert_allclose(north, [0, 111.4], atol=0.3)
    np.testing.assert_allclose(east, [55.8, 0], atol=0.3)
    assert east_north_m([]).shape == (0, 2)


@pytest.mark.parametrize("count", [2, 3, 50])
def test_links_join_everything_and_are_listed_once(count: int) -> None:
    rng = np.random.default_rng(count)
    distances = rng.random((count, count))
    distances += distances.T
    np.fill_diagonal(distances, 0)
    links = nearest_links(distances, 1)
    assert np.all(links[:, 0] < links[:, 1])
    assert len(np.unique(links, axis=0)) == len(links)
    assert groups(range(count), links.tolist()) == 1


def test_pictures_of_one_place_are_found_by_their_looks(walk: PathCapture, looks: dict[str, GlobalDescriptor]) -> None:
    names = list(walk.poses)
    pairs = retrieval_pairs(names, looks, neighbours=5).pairs
    apart = [np.linalg.norm(walk.poses[a].center - walk.poses[b].center) for a, b in pairs]
    assert np.mean(np.array(apart) < SIGHT) > 0.95  # by chance it would be 0.35
    assert groups(names, pairs) == 1
    next_ones = set(pairwise(names))
    assert len(next_ones & set(pairs)) > 0.6 * len(next_ones)


def test_a_sample_of_key_points_finds_neighbours_that_the_vectors_miss(walk: PathCapture) -> None:
    """Half of the neighbours' vectors are those of other places, as where all rooms have the same textures."""
    names = list(walk.poses)
    looks = {name: vlad_descriptor(walk.features[name], sample=200) for name in names}
    misled = {name: replace(looks[name], vector=looks[names[idx * 7 % 40]].vector) for idx, name in enumerate(names)}
    without = {name: replace(found, sample=np.zeros((0, 0), np.int16)) for name, found in misled.items()}

    def share_near(descriptors: Mapping[str, GlobalDescriptor]) -> float:
        pairs = retrieval_pairs(names, descriptors, neighbours=3).pairs
        return float(np.mean([np.linalg.norm(walk.poses[a].center - walk.poses[b].center) < SIGHT for a, b in pairs]))

    assert share_near(misled) > 0.95
    assert share_near(without) < 0.7


@pytest.mark.parametrize("metric", ["l2", "hamming"])
def test_matches_of_samples_are_those_of_matching_them(metric: Literal["l2", "hamming"]) -> None:
    rng = np.random.default_rng(5)
    size, kind = (64, np.float32) if metric == "l2" else (32, np.uint8)
    common = rng.integers(0, 200, (30, size)).astype(kind)
    found = [
        features(np.concatenate([common[:part], rng.integers(0, 200, (40, size)).astype(kind)]), metric)
        for part in (30, 20, 0)
    ]
    samples = [vlad_descriptor(one, sample=100).sample for one in found]
    counts = sample_matches(samples, np.zeros((3, 3)), neighbours=2)
    np.testing.assert_array_equal(counts, counts.T)
    assert counts[0, 1] >= 20 > 5 > counts[0, 2]
    assert not np.diag(counts).any()
    if metric == "l2":
        assert counts[0, 1] == len(match_features(found[0], found[1]))


def test_samples_of_other_kinds_or_none_match_nothing() -> None:
    samples = [np.zeros((0, 0), np.int16), np.ones((4, 8), np.int16), np.ones((4, 16), np.int16)]
    assert not sample_matches(samples, np.zeros((3, 3)), neighbours=1).any()


def test_compiled_and_plain_comparison_count_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    samples = [rng.integers(0, 12, (50, 8)).astype(np.int16) for _ in range(4)]
    compiled = sample_matches(samples, np.zeros((4, 4)), neighbours=3)
    monkeypatch.setattr("pano_mvs.algorithms.matching.nearest_two.can_compare_as_integers", lambda _: False)
    np.testing.assert_array_equal(sample_matches(samples, np.zeros((4, 4)), neighbours=3), compiled)


def test_looks_of_a_picture_depend_on_this_picture_alone(walk: PathCapture, looks: dict[str, GlobalDescriptor]) -> None:
    name = list(walk.features)[7]
    again = vlad_descriptor(walk.features[name])
    again.check()
    np.testing.assert_array_equal(again.vector, looks[name].vector)
    np.testing.assert_array_equal(again.vector, np.rint(again.vector))
    assert np.linalg.norm(again.vector) == pytest.approx(1024, rel=0.01)


@pytest.mark.parametrize(("metric", "size"), [("l2", 128), ("hamming", 32), ("l2", 61), ("hamming", 64)])
def test_common_key_points_make_pictures_alike(metric: Literal["l2", "hamming"], size: int) -> None:
    rng = np.random.default_rng(3)

    def draw(count: int) -> NDArray[Any]:
        if metric == "l2":
            return rng.integers(0, 200, size=(count, size)).astype(np.float32)
        return rng.integers(0, 256, size=(count, size), dtype=np.uint8)

    first, common, other = draw(300), draw(300), draw(600)
    a, b, c = (
        vlad_descriptor(features(d, metric)).vector.astype(float)
        for d in (np.concatenate([first, common]), np.concatenate([common, draw(300)]), other)
    )
    assert a @ b > 1.5 * max(a @ c, b @ c) + 0.05 * 1024**2


@pytest.mark.parametrize(("metric", "dtype"), [("l2", np.float32), ("hamming", np.uint8)])
def test_a_picture_without_key_points_looks_like_nothing(metric: Literal["l2", "hamming"], dtype: type[Any]) -> None:
    empty = vlad_descriptor(features(np.zeros((0, 32), dtype), metric))
    empty.check()
    assert not empty.vector.any()
    some = {"a": empty, "b": GlobalDescriptor(np.ones_like(empty.vector)), "c": empty}
    assert groups("abc", retrieval_pairs(list(some), some, neighbours=1).pairs) == 1
    assert retrieval_pairs(["a"], some).pairs == ()


def test_a_walk_is_closed_where_it_comes_back(walk: PathCapture, looks: dict[str, GlobalDescriptor]) -> None:
    """The same walk twice: the second time its pictures look like those of the first."""
    names = list(walk.poses)[:10]
    twice = names + [f"again/{name}" for name in names]
    both = {name: looks[name.removeprefix("again/")] for name in twice}
    pairs = loop_closing_pairs(twice, both, window=2, loop_closure=1)
    pairs.check()
    window = set(sequential_pairs(twice, window=2).pairs)
    assert window <= set(pairs.pairs)
    added = set(pairs.pairs) - window
    assert {(name, f"again/{name}") for name in names} <= added
    assert list(pairs.pairs) == sorted(pairs.pairs, key=lambda pair: [twice.index(name) for name in pair])


def test_without_loop_closure_only_the_window_counts(looks: dict[str, GlobalDescriptor]) -> None:
    names = list(looks)
    assert (
        loop_closing_pairs(names, {}, window=3, loop=True).pairs == sequential_pairs(names, window=3, loop=True).pairs
    )


def test_numbers_of_neighbours_are_checked(looks: dict[str, GlobalDescriptor]) -> None:
    calls: list[Callable[[], object]] = [
        lambda: position_pairs(["a"], {}, neighbours=0),
        lambda: position_pairs(["a"], {}, window=0),
        lambda: retrieval_pairs(list(looks), looks, neighbours=0),
    ]
    for wrong in calls:
        with pytest.raises(UsageError, match="at least 1"):
            wrong()


def shuffled(looks: Mapping[str, GlobalDescriptor]) -> dict[str, GlobalDescriptor]:
    return {name: looks[name] for name in np.random.default_rng(3).permutation(sorted(looks)).tolist()}


def test_few_images_are_all_paired(looks: dict[str, GlobalDescriptor]) -> None:
    pairs, reason = automatic_pairs(looks, {}, {})
    assert (set(pairs.pairs), reason) == (set(exhaustive_pairs(list(looks)).pairs), "")


@pytest.mark.parametrize("candidates", [3, 10])
def test_many_images_have_bounded_pairs_of_the_same_place(
    walk: PathCapture, looks: dict[str, GlobalDescriptor], candidates: int
) -> None:
    pairs, reason = automatic_pairs(shuffled(looks), {}, {}, candidates=candidates)
    pairs.check()
    assert groups(looks, pairs.pairs) == 1
    assert len(pairs.pairs) <= most_pairs(len(looks), candidates) + len(looks) - 1
    apart = [np.linalg.norm(walk.poses[a].center - walk.poses[b].center) for a, b in pairs.pairs]
    assert np.mean(np.array(apart) < SIGHT) > 0.8  # by chance it would be 0.35
    assert "order" not in reason


def test_order_counts_where_images_look_like_those_before(looks: dict[str, GlobalDescriptor]) -> None:
    pairs, reason = automatic_pairs(looks, {}, {}, candidates=7)
    assert set(sequential_pairs(list(looks), window=5).pairs) <= set(pairs.pairs)
    assert reason.startswith("the next 5 in order")


def test_positions_count_where_images_have_them(looks: dict[str, GlobalDescriptor]) -> None:
    """Half of the images have positions, at random, so that nothing else would pair those that are nearest."""
    rng = np.random.default_rng(4)
    places = {name: rng.normal(size=2) for name in list(looks)[::2]}
    pairs, reason = automatic_pairs(shuffled(looks), places, {}, candidates=12)
    nearest = position_pairs(list(places), places, neighbours=10).pairs
    assert {frozenset(pair) for pair in nearest} <= {frozenset(pair) for pair in pairs.pairs}
    assert f"positions of {len(places)}" in reason


@pytest.mark.parametrize("candidates", [2, 12])
def test_linked_images_are_paired_first(looks: dict[str, GlobalDescriptor], candidates: int) -> None:
    """Links at random, so that nothing else would pair those images; each is stated by one of its ends alone."""
    mixed, rng = shuffled(looks), np.random.default_rng(8)
    names = list(mixed)
    order = rng.permutation(names).tolist()
    links = {a: (b, "gone", a) for a, b in pairwise(order)}
    pairs, reason = automatic_pairs(mixed, {}, links, candidates=candidates)
    pairs.check()
    wanted = {frozenset(pair) for pair in pairwise(order)}
    assert wanted <= {frozenset(pair) for pair in pairs.pairs}
    unlinked = {frozenset(pair) for pair in automatic_pairs(mixed, {}, {}, candidates=candidates)[0].pairs}
    assert not wanted <= unlinked
    assert len(pairs.pairs) <= most_pairs(len(names), candidates) + len(names) - 1
    assert f"the {len(names) - 1} links between them" in reason


def test_of_many_links_the_similar_ones_count(looks: dict[str, GlobalDescriptor]) -> None:
    names = list(looks)
    everything = dict.fromkeys(names, tuple(names))
    pairs, _ = automatic_pairs(shuffled(looks), {}, everything, candidates=7)
    assert pairs.pairs == automatic_pairs(shuffled(looks), {}, {}, candidates=7)[0].pairs


def test_of_images_at_one_place_the_similar_ones_are_paired(looks: dict[str, GlobalDescriptor]) -> None:
    at_one_place = dict.fromkeys(looks, np.zeros(2))
    mixed = shuffled(looks)
    pairs, _ = automatic_pairs(mixed, at_one_place, {}, candidates=10)
    assert pairs.pairs == automatic_pairs(mixed, {}, {}, candidates=10)[0].pairs
