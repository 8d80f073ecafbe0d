"""Select the points of a cloud to write, in bounded memory.

`algorithms.fusion` averages the points of a voxel while the cloud is made. Here one point of each voxel is
selected from a finished cloud, which may be larger than memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import check_settings, setting
from pano_mvs.scene import PointCloud

CHUNK_POINTS = 1 << 18
"""Number of points that are processed at a time."""

_BUCKET_POINTS = 1 << 22
# The three indices of a voxel are packed into 63 bits.
_INDEX_BITS = 21
_MAX_INDEX = 1 << _INDEX_BITS
_CANDIDATE = np.dtype([("place", "<u8"), ("rank", "<u2"), ("off_center", "<f4"), ("idx", "<i8")])
_FULL_ENOUGH = 0.93


@dataclass(frozen=True, slots=True)
class Selection:
    """Criteria for the points of a cloud; `max_points` enlarges the voxels as necessary."""

    min_confidence: int = setting(0, ge=0, le=255, doc="minimum confidence of a point")
    min_views: int = setting(0, ge=0, le=255, doc="minimum number of views that agree on a point")
    voxel: float = setting(
        0.0, ge=0, doc="keep the best point of each voxel with this edge, in scene units; 0: keep all"
    )
    max_points: int = setting(0, ge=0, doc="thin evenly to at most this number of points; 0: no limit")

    def __post_init__(self) -> None:
        check_settings(self)


class SelectedPoints:
    """Selected points of a cloud, one bit per point."""

    def __init__(self, bits: NDArray[np.uint8], *, voxel: float) -> None:
        """Take the bits; that of the first point is the lowest of the first byte."""
        self._bits = bits
        self.voxel = voxel
        self.count = sum(int(np.unpackbits(part).sum()) for part in np.array_split(bits, 64))

    def within(self, chunk: slice) -> NDArray[np.bool_]:
        """Return which points of a chunk, whose start is a multiple of 8, are selected."""
        bits = self._bits[chunk.start // 8 : -(-chunk.stop // 8)]
        return np.unpackbits(bits, bitorder="little")[: chunk.stop - chunk.start].astype(np.bool_)


def chunks(count: int) -> Iterator[slice]:
    """Yield slices of at most `CHUNK_POINTS` points that cover a cloud.

    >>> list(chunks(300_000))
    [slice(0, 262144, None), slice(262144, 300000, None)]
    """
    for start in range(0, count, CHUNK_POINTS):
        yield slice(start, min(start + CHUNK_POINTS, count))


def select_points(cloud: PointCloud, selection: Selection, scratch: Path) -> SelectedPoints | None:
    """Return the selected points of a cloud, or None if all are selected.

    Each voxel keeps its most confident point; among equals the point that more views agree on, then the point nearest
    to the centre of the voxel, then the first. The result does not depend on the chunks, and points are not changed.
    Memory: one bit per point, one chunk, and one bucket of candidates (at most about 400 MB if hashing spreads voxels
    evenly). The candidates are in files, with 22 bytes per point.

    Args:
        cloud: its arrays may be memory-mapped; they are read in chunks.
        selection: the criteria.
        scratch: an empty folder for files that are removed again.

    Raises:
        UsageError: if the cloud is more than 2 million voxels wide.
    """
    if selection == Selection() or not len(cloud):
        return None
    voxel = selection.voxel
    bits = np.zeros(-(-len(cloud) // 8), np.uint8)
    for chunk in chunks(len(cloud)):
        good = cloud.view_counts[chunk] >= selection.min_views
        if cloud.confidence is not None:
            good &= cloud.confidence[chunk] >= selection.min_confidence
        bits[chunk.start // 8 : -(-chunk.stop // 8)] = np.packbits(good, bitorder="little")
    if selection.max_points:
        voxel = voxel_for_count(cloud, SelectedPoints(bits, voxel=0), selection)
    if voxel:
        bits = _thinned_bits(cloud, SelectedPoints(bits, voxel=voxel), scratch)
    return SelectedPoints(bits, voxel=voxel)


def voxel_for_count(cloud: PointCloud, good: SelectedPoints, selection: Selection) -> float:
    """Return the edge of voxels, at least `selection.voxel`, that leaves `max_points` points or slightly fewer.

    The number of occupied voxels is estimated from a hashed sample of about 16,000, to 1 %. On surfaces it
    is inversely proportional to the square of the edge, with which a secant search on logarithms begins.
    """
    wanted = 0.98 * selection.max_points
    if good.count <= selection.max_points and not selection.voxel:
        return 0.0
    share = max(1, selection.max_points // (1 << 14))
    if selection.voxel and _occupied(cloud, good, selection.voxel, share=share) <= selection.max_points:
        return selection.voxel
    reach = 1e-6
    for chunk in chunks(len(cloud)):
        points = cloud.points_in_world[chunk][good.within(chunk)]
        reach = max(reach, float(np.abs(points).max(initial=0)))
    smallest = max(selection.voxel, 2 * reach / (_MAX_INDEX - 2))
    # A rough model of rooms is a cube from −1 to 1, whose surface is 24.
    edge, slope = max(smallest, reach * np.sqrt(24.0 / wanted)), -2.0
    tried: list[tuple[float, float]] = []
    fitting: list[float] = []
    while len(tried) < 8 or (not fitting and edge < 4 * reach):
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


def _occupied(cloud: PointCloud, good: SelectedPoints, edge: float, *, share: int) -> int:
    """Estimate the number of voxels with a good point by counting those whose hash is a multiple of `share`."""
    found = np.zeros(0, np.uint64)
    for chunk in chunks(len(cloud)):
        place = _places(cloud.points_in_world[chunk][good.within(chunk)], edge)[0]
        found = np.union1d(found, place[_hashed(place) % np.uint64(share) == 0])
    return len(found) * share


def _places(points: NDArray[np.float32], edge: float) -> tuple[NDArray[np.uint64], NDArray[np.float32]]:
    """Return each point's voxel as one number, and its squared distance from the voxel's centre in edges."""
    scaled = points.astype(np.float64) / edge
    floor = np.floor(scaled)
    index = floor + _MAX_INDEX // 2
    if index.size and not (index.min() >= 0 and index.max() < _MAX_INDEX):
        raise UsageError(
            f"voxels of {edge:g} are too small for a cloud that reaches {np.abs(points).max():g} from the "
            f"origin: {2 * np.abs(points).max() / _MAX_INDEX:.3g} is the least"
        )
    x, y, z = index.astype(np.uint64).T
    place = (x << np.uint64(2 * _INDEX_BITS)) | (y << np.uint64(_INDEX_BITS)) | z
    return place, ((scaled - floor - 0.5) ** 2).sum(axis=1).astype(np.float32)


def _hashed(place: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return a 64-bit hash of each number (the finaliser of SplitMix64, Steele, Lea & Flood 2014)."""
    mixed = (place ^ (place >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    hashed: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return hashed


def _thinned_bits(cloud: PointCloud, good: SelectedPoints, scratch: Path) -> NDArray[np.uint8]:
    """Return the bits of the best point of each voxel."""
    number = min(256, -(-len(cloud) // _BUCKET_POINTS))
    paths = [scratch / f"bucket_{idx}" for idx in range(number)]
    for chunk in chunks(len(cloud)):
        candidates = _best(_candidates(cloud, good, chunk))
        bucket = (_hashed(candidates["place"]) >> np.uint64(32)) % np.uint64(number)
        for idx, path in enumerate(paths):
            with path.open("ab") as stream:
                stream.write(candidates[bucket == idx].tobytes())
    bits = np.zeros(-(-len(cloud) // 8), np.uint8)
    for path in paths:
        selected = _best(np.fromfile(path, _CANDIDATE))["idx"]
        np.bitwise_or.at(bits, selected // 8, (1 << (selected % 8)).astype(np.uint8))
        path.unlink()
    return bits


def _candidates(cloud: PointCloud, good: SelectedPoints, chunk: slice) -> NDArray[np.void]:
    selected = np.flatnonzero(good.within(chunk))
    candidates = np.zeros(len(selected), _CANDIDATE)
    candidates["place"], candidates["off_center"] = _places(cloud.points_in_world[chunk][selected], good.voxel)
    confidence = 0 if cloud.confidence is None else cloud.confidence[chunk][selected].astype(np.uint16)
    candidates["rank"] = 65535 - (256 * confidence + cloud.view_counts[chunk][selected].astype(np.uint16))
    candidates["idx"] = chunk.start + selected
    return candidates


def _best(candidates: NDArray[np.void]) -> NDArray[np.void]:
    """Return the best candidate of each voxel."""
    order = np.lexsort((candidates["idx"], candidates["off_center"], candidates["rank"], candidates["place"]))
    place = candidates["place"][order]
    first = np.ones(len(order), np.bool_)
    first[1:] = place[1:] != place[:-1]
    best: NDArray[np.void] = candidates[order[first]]
    return best
