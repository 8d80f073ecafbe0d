"""Choose pairs of images to match by position or by visual similarity."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.nearest_two import Comparable
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry.geodesy import local_from_lla
from pano_mvs.scene import Features, GlobalDescriptor, Pairs

_WINDOW, _NEAREST = 5, 10  # the defaults of pairs.sequential and pairs.position


@checks_settings
def position_pairs(
    names: Sequence[str],
    positions: Mapping[str, FloatArray],
    *,
    neighbours: Annotated[int, Setting("number of nearest images to match each image with", ge=1)] = 10,
    window: Annotated[int, Setting("for images without position: number of images before and after", ge=1)] = 3,
) -> Pairs:
    """Pair every image with its nearest ones, so that all images are connected.

    A pair is included if either image is among the nearest of the other. If this leaves separate groups, the shortest
    links that join them are added.

    Args:
        names: image names in the capture's order.
        positions: image name to position, (2,) or (3,), all in one frame and unit; some may be missing.

    Raises:
        UsageError: if a number of neighbours is less than 1.
    """
    known = np.array([idx for idx, name in enumerate(names) if name in positions], np.intp)
    places = np.array([positions[names[idx]] for idx in known], np.float64)
    found = (
        known[nearest_links(_squared_distances(places), neighbours)] if len(known) > 1 else np.zeros((0, 2), np.intp)
    )
    lost = set(range(len(names))) - set(known.tolist())
    beside = {
        (min(idx, other), max(idx, other))
        for idx in lost
        for other in range(max(0, idx - window), min(len(names), idx + window + 1))
        if other != idx
    }
    return _named(names, beside | {(a, b) for a, b in found.tolist()})


@checks_settings
def retrieval_pairs(
    names: Sequence[str],
    descriptors: Mapping[str, GlobalDescriptor],
    *,
    neighbours: Annotated[int, Setting("number of most similar panoramas to match each one with", ge=1)] = 20,
) -> Pairs:
    """Pair every image with the most similar ones, so that all images are connected.

    The vectors of the global descriptors give a shortlist for each image (all images in captures of up to a few
    hundred), which is sorted by the number of matching key points of their samples (see `sample_matches`). A pair is
    included if either image is among the most similar of the other. If this leaves separate groups, the most similar
    links that join them are added.

    Args:
        names: image names in the capture's order.
        descriptors: image name to its global descriptor; images without one are not paired.

    Raises:
        UsageError: if the number of neighbours is less than 1.
    """
    known = [name for name in names if name in descriptors]
    if len(known) < 2:
        return Pairs(())
    apart = _dissimilarities(known, descriptors, neighbours)
    return _named(known, {(a, b) for a, b in nearest_links(apart, neighbours).tolist()})


@checks_settings
def loop_closing_pairs(
    names: Sequence[str],
    descriptors: Mapping[str, GlobalDescriptor],
    *,
    window: Annotated[int, Setting("number of following images to match each image with", ge=1)] = 5,
    loop: Annotated[bool, Setting("the first image follows the last one")] = False,
    loop_closure: Annotated[
        int, Setting("number of similar images beyond the window to match as well; requires global.vlad", ge=0)
    ] = 0,
) -> Pairs:
    """Return the sequential pairs and, for every image, pairs with the most similar images outside its window.

    Args:
        names: image names in the order in which they were taken.
        descriptors: image name to its global descriptor.

    Raises:
        UsageError: if the window is less than 1.
    """
    pairs = set(sequential_pairs(names, window=window, loop=loop).pairs)
    known = [name for name in names if name in descriptors]
    if loop_closure and len(known) > 1:
        place = {name: idx for idx, name in enumerate(names)}
        number = {name: idx for idx, name in enumerate(known)}
        apart = _dissimilarities(known, descriptors, loop_closure)
        for a, b in pairs:
            if a in number and b in number:
                apart[number[a], number[b]] = apart[number[b], number[a]] = np.inf
        links = _nearest(apart, loop_closure)
        pairs |= {(known[a], known[b]) for a, b in links.tolist()}
        return Pairs(tuple(sorted(pairs, key=lambda pair: (place[pair[0]], place[pair[1]]))))
    return sequential_pairs(names, window=window, loop=loop)


@checks_settings
def automatic_pairs(
    descriptors: Mapping[str, GlobalDescriptor],
    positions: Mapping[str, FloatArray],
    links: Mapping[str, Collection[str]],
    *,
    candidates: Annotated[
        int, Setting("number of images to match each one with; all pairs are matched while these are no more", ge=1)
    ] = 28,
) -> tuple[Pairs, str]:
    """Return every pair while there are few, and else a bounded number for each image from all that the capture offers.

    An image is paired with those that it is linked with, then with the ones that follow it, if at least half of the
    images are among the most similar ones of the image before. To these are added the images that are nearest by
    position (of images at one place, the most similar ones), and as many of the most similar ones as are left of
    `candidates`; these close loops. Separate groups are joined by the most similar links.

    Args:
        descriptors: image name to its global descriptor, in the capture's order.
        positions: image name to position in one frame and unit; some or all may be missing.
        links: image name to the images that are known to lie nearby, in either direction; some or all may be missing.
            If they are more than `candidates`, the most similar ones count.
        candidates: each image adds at most this number of pairs.

    Returns:
        The pairs, and what they were chosen by; "" for all pairs.

    Raises:
        UsageError: if the number of candidates is less than 1.
    """
    names, count = tuple(descriptors), len(descriptors)
    if most_pairs(count, candidates) == count * (count - 1) // 2:
        return exhaustive_pairs(names), ""
    looks = _dissimilarities(names, descriptors, candidates)
    left, chosen, reasons = np.full(count, candidates), np.eye(count, dtype=np.bool_), list[str]()
    if (linked := _linked(names, links)).any():
        number = np.minimum(linked.sum(axis=1), left)
        _choose(chosen, number, looks, apart=np.where(linked, 0.0, np.inf))
        left -= number
        reasons.append(f"the {np.count_nonzero(np.triu(linked))} links between them")
    following = _share_that_follow(looks)
    if following >= 0.5:
        window = min(_WINDOW, candidates)
        for step in range(1, window + 1):
            before = np.flatnonzero(left[:-step] >= step)
            chosen[before, before + step] = chosen[before + step, before] = True
        left -= np.minimum(window, left)
        reasons.append(f"the next {window} in order, because {100 * following:.0f} % look like the one before")
    located = np.array([name in positions for name in names])
    if located.any():
        places = np.array([positions[name] for name in names if name in positions], np.float64)
        apart = np.full((count, count), np.inf)
        apart[np.ix_(located, located)] = _squared_distances(places)
        nearest = np.where(located, np.minimum(_NEAREST, left), 0)
        _choose(chosen, nearest, looks, apart=apart)
        left -= nearest
        reasons.append(f"the {nearest.max()} nearest by the positions of {np.count_nonzero(located)}")
    _choose(chosen, left, looks)
    found = _joined(np.argwhere(np.triu(chosen, 1)), looks)
    reasons.append(f"{'the rest' if reasons else f'the {candidates} most similar'} by their key points")
    return _named(names, {(a, b) for a, b in found.tolist()}), ", ".join(reasons)


def _linked(names: Sequence[str], links: Mapping[str, Collection[str]]) -> NDArray[np.bool_]:
    """Return which images are linked in either direction, (N, N)."""
    idx_of = {name: idx for idx, name in enumerate(names)}
    linked = np.zeros((len(names), len(names)), np.bool_)
    for name in links.keys() & idx_of.keys():
        others = [idx_of[other] for other in links[name] if other in idx_of and other != name]
        linked[idx_of[name], others] = linked[others, idx_of[name]] = True
    return linked


def most_pairs(images: int, candidates: int) -> int:
    """Return the most pairs that `automatic_pairs` chooses before it joins separate groups."""
    return min(candidates * images, images * (images - 1) // 2)


def nearest_links(distances: FloatArray, neighbours: int) -> NDArray[np.intp]:
    """Return the links of each item to its nearest ones, and the shortest ones that join separate groups.

    Args:
        distances: (N, N) symmetric, not negative.
        neighbours: number of nearest items.

    Returns:
        (M, 2) positions, first before second, sorted, no link twice.
    """
    return _joined(_nearest(distances, neighbours), distances)


def _joined(links: NDArray[np.intp], distances: FloatArray) -> NDArray[np.intp]:
    """Return links and the shortest ones that join separate groups, sorted."""
    # scipy does not treat a zero as an edge; existing links already cost less than anything else.
    cost = distances - distances.min() + distances.max() + 1.0
    np.fill_diagonal(cost, 0)
    cost[links[:, 0], links[:, 1]] = cost[links[:, 1], links[:, 0]] = 1e-3
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_array(np.triu(cost))).tocoo()
    joined = np.stack([np.minimum(tree.row, tree.col), np.maximum(tree.row, tree.col)], axis=1)
    return np.unique(np.concatenate([links, joined]), axis=0)


def east_north_m(positions_lla: Sequence[tuple[float, float, float]]) -> FloatArray:
    """Return GPS positions as metres east and north of their mean, (N, 2), on its tangent plane.

    Altitudes are ignored: those of GPS are off by tens of metres, or missing and stored as zero.

    Args:
        positions_lla: latitude and longitude in degrees, altitude in metres.
    """
    if not positions_lla:
        return np.zeros((0, 2))
    east_down_north = local_from_lla(positions_lla, np.mean(positions_lla, axis=0))
    return np.asarray(east_down_north[:, [0, 2]], np.float64)


def _nearest(distances: FloatArray, neighbours: int) -> NDArray[np.intp]:
    """Return links (first < second) of each item to its nearest ones; infinite distances are not links."""
    chosen = np.eye(len(distances), dtype=np.bool_)
    _choose(chosen, np.full(len(distances), neighbours), distances)
    return np.argwhere(np.triu(chosen, 1))


def _share_that_follow(looks: FloatArray) -> float:
    """Return the share of images that are among the most similar ones of the image before them; by chance few are."""
    apart = looks.copy()
    np.fill_diagonal(apart, np.inf)
    following = np.diagonal(apart, offset=1)
    return float(np.mean(np.count_nonzero(apart[:-1] < following[:, None], axis=1) < _WINDOW))


def _choose(
    chosen: NDArray[np.bool_], counts: NDArray[np.intp], looks: FloatArray, *, apart: FloatArray | None = None
) -> None:
    """Add to `chosen`, (N, N), for each image the nearest others that are not chosen, at most (N,) counts of them.

    Of those at equal distances, or without distances, the ones that are least dissimilar come first.
    """
    free = np.where(chosen, np.inf, looks if apart is None else apart)
    order = np.argsort(free, axis=1, kind="stable") if apart is None else np.lexsort((looks, free), axis=1)
    order = order[:, : counts.max()]
    taken = np.isfinite(np.take_along_axis(free, order, axis=1)) & (np.arange(order.shape[1]) < counts[:, None])
    rows, columns = np.repeat(np.arange(len(free)), taken.sum(axis=1)), order[taken]
    chosen[rows, columns] = chosen[columns, rows] = True


def _squared_distances(places: FloatArray) -> FloatArray:
    return np.asarray(np.sum([np.subtract.outer(axis, axis) ** 2 for axis in places.T], axis=0), np.float64)


def _dissimilarities(names: Sequence[str], descriptors: Mapping[str, GlobalDescriptor], neighbours: int) -> FloatArray:
    """Return the dissimilarity of images, (N, N), not negative; integers, so that the order of summation has no effect.

    More matches of the samples make two images more similar; the vectors decide between equal numbers of matches.
    """
    vectors = np.array([descriptors[name].vector for name in names], np.float32)
    alike = (vectors @ vectors.T).astype(np.float64)
    by_looks = np.asarray(alike.max() - alike, np.float64)
    matches = sample_matches([descriptors[name].sample for name in names], by_looks, neighbours=neighbours)
    return np.asarray(by_looks + (by_looks.max() + 1) * (matches.max() - matches), np.float64)


def similarities(features: Collection[Features], *, sample: int = 400) -> FloatArray:
    """Return the similarity of images, (N, N): matches of samples of their key points, then their VLAD vectors."""
    names = [str(number) for number in range(len(features))]
    descriptors = {name: vlad_descriptor(one, sample=sample) for name, one in zip(names, features, strict=True)}
    return -_dissimilarities(names, descriptors, 20)


def _named(names: Sequence[str], links: set[tuple[int, int]]) -> Pairs:
    return Pairs(tuple((names[first], names[second]) for first, second in sorted(links)))


def sample_matches(
    samples: Sequence[NDArray[np.int16]], dissimilarities: NDArray[np.float64], *, neighbours: int
) -> NDArray[np.float64]:
    """Return the number of matching key points of two samples, for pairs on the shortlist of either image.

    Matching a few key points of coarse scales separates overlapping images from others before the rest is matched (Wu,
    "Towards linear-time incremental structure from motion", 2013, section 3.1). A match is mutual and passes the ratio
    test. Time is linear in the number of images once it exceeds the length of a shortlist.

    Args:
        samples: descriptors as integers, (S, B) each; an empty one matches nothing.
        dissimilarities: (N, N), approximate dissimilarity of the images, by which shortlists are made.
        neighbours: number of neighbours that will be chosen; a shortlist has 10 times as many images, at least 300.

    Returns:
        (N, N) symmetric; zero for pairs on no shortlist and on the diagonal.
    """
    count = len(samples)
    length = min(count, max(300, 10 * neighbours))
    listed = np.zeros((count, count), np.bool_)
    np.put_along_axis(listed, np.argsort(dissimilarities, axis=1, kind="stable")[:, :length], values=True, axis=1)
    listed = np.triu(listed | listed.T, 1)
    matches = np.zeros((count, count))
    comparable = [Comparable(sample) for sample in samples]
    for first, second in np.argwhere(listed).tolist():
        a, b = samples[first], samples[second]
        if len(a) > 0 and len(b) >= 2 and a.shape[1] == b.shape[1]:  # of one kind, and enough for a ratio test
            matches[first, second] = np.count_nonzero(comparable[first].nearest_two(comparable[second]).mutual())
    return matches + matches.T


def exhaustive_pairs(names: Sequence[str]) -> Pairs:
    """Return every pair of images, in the order of the capture."""
    return Pairs(tuple(combinations(names, 2)))


def sequential_pairs(names: Sequence[str], *, window: int = 5, loop: bool = False) -> Pairs:
    """Return the pairs of images that are at most `window` positions apart.

    Args:
        names: image names in the order in which they were taken.
        window: each image is paired with this number of following images.
        loop: whether the first image follows the last one.

    Raises:
        UsageError: if the window is less than 1.
    """
    if window < 1:
        raise UsageError(f"the window of sequential pairs must be at least 1, got {window}")
    count = len(names)
    pairs = {
        (min(first, second), max(first, second))
        for first in range(count)
        for second in (first + step for step in range(1, window + 1))
        for second in ([second] if second < count else [second % count] if loop else [])
        if first != second
    }
    return Pairs(tuple((names[first], names[second]) for first, second in sorted(pairs)))
