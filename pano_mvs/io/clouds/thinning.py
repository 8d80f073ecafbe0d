"""Which points of a cloud to write, found in memory that does not grow with the cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.scene import PointCloud

CHUNK_POINTS = 1 << 18
"""Points that are held at a time."""

_BUCKET_POINTS = 1 << 22
_MOST_BUCKETS = 256
# Three coordinates in one number of 63 bits.
_PLACE_BITS = 21
_MOST_PLACES = 1 << _PLACE_BITS
_CANDIDATE = np.dtype([("place", "<u8"), ("rank", "<u2"), ("off_center", "<f4"), ("idx", "<i8")])
_COUNTED_VOXELS = 1 << 14
_CUBE_SURFACE = 24.0  # of a cube from −1 to 1: what rooms have more or less
_FEWEST_ROUNDS = 8
_FULL_ENOUGH = 0.93


@dataclass(frozen=True, slots=True)
class Selection:
    """Which points of a cloud are wanted.

    Attributes:
        min_confidence: points below are left out; 0: none.
        min_views: points on which fewer views agree are left out.
        voxel: edge in scene units of the voxels of which each keeps one point; 0: all are kept.
        max_points: the voxels grow until no more points than this are left; 0: any number.
    """

    min_confidence: int = 0
    min_views: int = 0
    voxel: float = 0.0
    max_points: int = 0


class Kept:
    """The points of a cloud that are kept, one bit each.

    Attributes:
        count: how many they are.
        voxel: edge of the voxels that were used; 0 if none were.
    """

    def __init__(self, bits: NDArray[np.uint8], *, voxel: float) -> None:
        """Take the bits, the first point's in the lowest."""
        self._bits = bits
        self.voxel = voxel
        self.count = sum(int(np.unpackbits(part).sum()) for part in np.array_split(bits, 64))

    def within(self, chunk: slice) -> NDArray[np.bool_]:
        """Return of each point of a chunk, which begins at a multiple of eight, whether it is kept."""
        bits = self._bits[chunk.start // 8 : -(-chunk.stop // 8)]
        return np.unpackbits(bits, bitorder="little")[: chunk.stop - chunk.start].astype(np.bool_)


def chunks(count: int) -> Iterator[slice]:
    """Yield the stretches in which a cloud of so many points is gone through.

    >>> list(chunks(300_000))
    [slice(0, 262144, None), slice(262144, 300000, None)]
    """
    for start in range(0, count, CHUNK_POINTS):
        yield slice(start, min(start + CHUNK_POINTS, count))


def select_points(cloud: PointCloud, selection: Selection, scratch: Path) -> Kept | None:
    """Return the points that are wanted, None if that is all of them.

    Of each voxel the most confident point is kept; of equals the one that more views agree on, then the one nearest to
    the voxel's centre, then the first: so the result does not depend on how the work is cut up. Points are never
    moved or mixed. Beside one bit for each point this takes memory for one chunk and one bucket of candidates (about
    400 MB at most, as long as hashing spreads voxels evenly); the candidates wait in files, 22 bytes for each point.

    Args:
        cloud: its arrays may be memory-mapped; they are read in chunks.
        selection: what is wanted.
        scratch: an empty folder for files that are removed again.

    Raises:
        UsageError: if the voxels are so small that the cloud is over 2 million of them wide.
    """
    if selection == Selection() or not len(cloud):
        return None
    voxel = selection.voxel
    bits = _good_bits(cloud, selection)
    if selection.max_points:
        voxel = voxel_for_count(cloud, Kept(bits, voxel=0), selection)
    if voxel:
        bits = _thinned_bits(cloud, Kept(bits, voxel=0), voxel, scratch)
    return Kept(bits, voxel=voxel)


def voxel_for_count(cloud: PointCloud, good: Kept, selection: Selection) -> float:
    """Return the edge of voxels, not below `selection.voxel`, that leaves `max_points` points or a little fewer.

    The number of occupied voxels is estimated from a hashed sample of them (some 16,000, so ± 1 %). On surfaces it
    falls with the square of the edge: a secant search on logarithms begins with that.
    """
    wanted = 0.98 * selection.max_points
    if good.count <= selection.max_points and not selection.voxel:
        return 0.0
    share = max(1, selection.max_points // _COUNTED_VOXELS)
    if selection.voxel and _occupied(cloud, good, selection.voxel, share=share) <= selection.max_points:
        return selection.voxel
    reach = _reach(cloud, good)
    smallest = max(selection.voxel, 2 * reach / (_MOST_PLACES - 2))
    edge, slope = max(smallest, reach * np.sqrt(_CUBE_SURFACE / wanted)), -2.0
    tried: list[tuple[float, float]] = []
    fitting: list[float] = []
    while len(tried) < _FEWEST_ROUNDS or (not fitting and edge < 4 * reach):
        count = max(1, _occupied(cloud, good, edge, share=share))
        if count <= wanted:
            fitting.append(edge)
            if count >= _FULL_ENOUGH * wanted or edge <= smallest:
                break
        tried.append((np.log(edge), np.log(count)))
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = np.clip((tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0]), -3.5, -0.5)
        aim = 0.5 * (1 + _FULL_ENOUGH) * wanted
        edge = max(smallest, float(np.exp(tried[-1][0] + (np.log(aim) - tried[-1][1]) / slope)))
    return min(fitting, default=edge)


def _good_bits(cloud: PointCloud, selection: Selection) -> NDArray[np.uint8]:
    bits = np.zeros(-(-len(cloud) // 8), np.uint8)
    for chunk in chunks(len(cloud)):
        good = cloud.view_counts[chunk] >= selection.min_views
        if cloud.confidence is not None:
            good &= cloud.confidence[chunk] >= selection.min_confidence
        bits[chunk.start // 8 : -(-chunk.stop // 8)] = np.packbits(good, bitorder="little")
    return bits


def _reach(cloud: PointCloud, good: Kept) -> float:
    """Return the largest coordinate of the good points, of whatever sign."""
    reach = 1e-6
    for chunk in chunks(len(cloud)):
        points = cloud.points_in_world[chunk][good.within(chunk)]
        reach = max(reach, float(np.abs(points).max(initial=0)))
    return reach


def _occupied(cloud: PointCloud, good: Kept, edge: float, *, share: int) -> int:
    """Return about how many voxels hold a good point; those whose hash is a multiple of `share` are counted."""
    found = np.zeros(0, np.uint64)
    for chunk in chunks(len(cloud)):
        place = _places(cloud.points_in_world[chunk][good.within(chunk)], edge)[0]
        found = np.union1d(found, place[_hashed(place) % np.uint64(share) == 0])
    return len(found) * share


def _places(points: NDArray[np.float32], edge: float) -> tuple[NDArray[np.uint64], NDArray[np.float32]]:
    """Return the voxel of each point as one number, and how far from its centre the point lies, in edges squared."""
    scaled = points.astype(np.float64) / edge
    floor = np.floor(scaled)
    index = floor + _MOST_PLACES // 2
    if index.size and not (index.min() >= 0 and index.max() < _MOST_PLACES):
        raise UsageError(f"voxels of {edge:g} are too small for a cloud that reaches {np.abs(points).max():g} from the "
                         f"origin: {2 * np.abs(points).max() / _MOST_PLACES:.3g} is the least")  # fmt: skip
    x, y, z = index.astype(np.uint64).T
    place = (x << np.uint64(2 * _PLACE_BITS)) | (y << np.uint64(_PLACE_BITS)) | z
    return place, ((scaled - floor - 0.5) ** 2).sum(axis=1).astype(np.float32)


def _hashed(place: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return 64 well-mixed bits of each number (the finaliser of SplitMix64, Steele, Lea & Flood 2014)."""
    mixed = (place ^ (place >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    hashed: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return hashed


def _thinned_bits(cloud: PointCloud, good: Kept, edge: float, scratch: Path) -> NDArray[np.uint8]:
    """Return the bits of the best point of each voxel."""
    number = min(_MOST_BUCKETS, -(-len(cloud) // _BUCKET_POINTS))
    paths = [scratch / f"bucket_{idx}" for idx in range(number)]
    for chunk in chunks(len(cloud)):
        candidates = _best(_candidates(cloud, good, chunk, edge))
        bucket = (_hashed(candidates["place"]) >> np.uint64(32)) % np.uint64(number)
        for idx, path in enumerate(paths):
            with path.open("ab") as stream:
                stream.write(candidates[bucket == idx].tobytes())
    bits = np.zeros(-(-len(cloud) // 8), np.uint8)
    for path in paths:
        kept = _best(np.fromfile(path, _CANDIDATE))["idx"]
        np.bitwise_or.at(bits, kept // 8, (1 << (kept % 8)).astype(np.uint8))
        path.unlink()
    return bits


def _candidates(cloud: PointCloud, good: Kept, chunk: slice, edge: float) -> NDArray[np.void]:
    kept = np.flatnonzero(good.within(chunk))
    candidates = np.zeros(len(kept), _CANDIDATE)
    candidates["place"], candidates["off_center"] = _places(cloud.points_in_world[chunk][kept], edge)
    confidence = 0 if cloud.confidence is None else cloud.confidence[chunk][kept].astype(np.uint16)
    candidates["rank"] = 65535 - (256 * confidence + cloud.view_counts[chunk][kept].astype(np.uint16))
    candidates["idx"] = chunk.start + kept
    return candidates


def _best(candidates: NDArray[np.void]) -> NDArray[np.void]:
    """Return the best candidate of each voxel; which is best of some bests is best of all."""
    order = np.lexsort((candidates["idx"], candidates["off_center"], candidates["rank"], candidates["place"]))
    place = candidates["place"][order]
    first = np.ones(len(order), np.bool_)
    first[1:] = place[1:] != place[:-1]
    best: NDArray[np.void] = candidates[order[first]]
    return best
