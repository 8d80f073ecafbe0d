"""The surface of a place from the ranges of all its panoramas.

Each cell of a grid gets the mean signed distance to the surfaces that panoramas measured near it, and the surface is
where this distance is 0 (B. Curless and M. Levoy, "A volumetric method for building complex models from range images",
SIGGRAPH 1996), extracted by surface nets (S. Gibson, "Constrained elastic surface nets", MICCAI 1998). Planes of the
place continue where nobody looked, and vertices near them move onto them, so that walls are straight and corners sharp.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY
from pano_mvs.algorithms.mesh.view_quality import face_normals, surface_view
from pano_mvs.algorithms.panoramas import filtered, square_window
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, MIRROR_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE

Surface = tuple[NDArray[np.float32], NDArray[np.int32]]
"""Vertices (V, 3) and triangles (F, 3), counter-clockwise as seen from the side that was seen."""

Planes = tuple[FloatArray, FloatArray]
"""Unit normals n (K, 3) towards the side that was seen, and offsets (K,): n · X = offset."""

NO_PLANES: Planes = np.zeros((0, 3)), np.zeros(0)

# Finer cells than these follow the noise of the ranges: pictures of views that were left out become worse.
MAX_CELLS = 1 << 23

_GAPS = 3, 5, 9, 17
# How much a range counts that is not confirmed; others count by the probability that they are right.
_LEAST_SUPPORT = np.float32(0.2)
# Distances are averaged up to this many cells from the surface.
_LIMIT_CELLS = 2.0


def most_certain(range_map: RangeMap, measured: RangeMap) -> RangeMap:
    """Return a range map with the measured ranges where they are confirmed and more accurate than planes of the place.

    Panes of mirrors stay: what was measured there is a reflection.

    `range_map`: completed and laid on planes. `measured`: the same view before.
    """
    if measured.uncertainty is None or range_map.uncertainty is None or measured.range.shape != range_map.range.shape:
        return range_map
    # Ranges on the planes of a place are not more accurate than 1 %.
    precise = (
        (measured.confidence >= CONSISTENT_CONFIDENCE[0])
        & (measured.uncertainty < np.fmax(range_map.uncertainty, 0.01))
        & (range_map.confidence != MIRROR_CONFIDENCE)
    )
    normals = range_map.normals_in_cam
    if normals is not None and measured.normals_in_cam is not None:
        normals = np.where(precise[..., None], measured.normals_in_cam, normals)
    return replace(
        range_map,
        range=np.where(precise, measured.range, range_map.range),
        confidence=np.where(precise, measured.confidence, range_map.confidence),
        uncertainty=np.where(precise, measured.uncertainty, range_map.uncertainty),
        normals_in_cam=normals,
        sky=None if range_map.sky is None else range_map.sky & ~precise,
    )


@dataclass(eq=False)
class Volume:
    """Signed distances in a grid of cubic cells.

    `origin`: (3,) centre of the first cell. `cell`: width of a cell. `distances`: (X, Y, Z) float32, positive in front
    of the surface, cut off two cells from it. `weights`: (X, Y, Z) float32, 0 where nothing was measured. `support`:
    (X, Y, Z) float32, negative where most panoramas see something farther away. `middle`: median range.
    """

    origin: FloatArray
    cell: float
    distances: NDArray[np.float32]
    weights: NDArray[np.float32]
    support: NDArray[np.float32]
    middle: float

    def add(self, range_map: RangeMap, cam_from_world: Rigid3, valid: Mask, *, threads: int = 1) -> None:
        """Add what a panorama measured.

        A range counts as the plane through its point, by the normal of the pixel, with weight 1 / (σ r)². It also
        supports a surface there, and contradicts surfaces before it, whatever its weight.

        `range_map`: (H, W). `cam_from_world`: its pose. `valid`: (H, W) pixels that are not masked. `threads`: number
        of threads; the result does not depend on it.
        """
        from pano_mvs.algorithms.mesh.kernels_mesh import add_distances  # compiles on import

        rays = ray_grid(range_map.range.shape)
        known = range_map.valid & valid
        ranges = np.where(known, range_map.range, np.float32(1e6 * self.middle)).astype(np.float32)
        deviation = np.maximum(_uncertainty(range_map) * ranges, 0.002 * self.middle)
        weights = np.where(known, (0.01 * self.middle / deviation) ** 2, 0.0).astype(np.float32)
        if range_map.sky is not None:
            weights[range_map.sky & valid] = 1.0
        confirmed, best = CONSISTENT_CONFIDENCE
        support = np.maximum((range_map.confidence.astype(np.float32) - confirmed) / (best - confirmed), _LEAST_SUPPORT)
        support[range_map.confidence == WINDOW_CONFIDENCE] = 1.0  # others look through it, but the pane is there
        # Beside an edge, a ray may pass the nearer surface or not.
        nearest = filtered(ranges, 1, lambda padded: cv2.erode(padded, square_window(1)))
        planes = np.empty((*ranges.shape, 4), np.float32)
        planes[..., :3] = -rays
        if range_map.normals_in_cam is not None:
            oriented = known & np.isfinite(range_map.normals_in_cam).all(axis=-1)
            planes[oriented, :3] = range_map.normals_in_cam[oriented]
        planes[..., 3] = ranges * np.einsum("ijk,ijk->ij", planes[..., :3], rays)
        pose = np.concatenate([cam_from_world.rotation, cam_from_world.translation[:, None]], axis=1)
        out = self.distances, self.weights, self.support

        def add_slab(first: int, count: int) -> None:
            grid, cells = (self.origin, self.cell, _LIMIT_CELLS * self.cell), (first, first + count)
            add_distances(grid, pose, (ranges, nearest, weights, support, planes), cells, out)

        for_bands(add_slab, len(self.distances), threads=threads)

    def close_gaps(self) -> None:
        """Give cells where nothing was measured the mean of what was measured around them, from near to far."""
        for size in _GAPS:
            known = (self.weights > 0).astype(np.float32)
            around = scipy.ndimage.uniform_filter(known, size, mode="constant")
            gaps = (known == 0) & (around > 0.25)
            means = scipy.ndimage.uniform_filter(self.distances * known, size, mode="constant")
            self.distances[gaps] = means[gaps] / around[gaps]
            self.weights[gaps] = np.finfo(np.float32).tiny

    def continue_planes(self, planes: Planes) -> None:
        """Let planes continue in cells where nothing was measured, within the closed outline of where they were seen.

        Where several do, the place is in front of all of them.
        """
        known = self.weights > 0
        filled = np.full(self.distances.shape, np.inf, np.float32)
        # Gaps of an outline that are narrower than twice this many cells are closed, and so are all its holes.
        radius = max(1, round(0.25 * self.middle / self.cell))
        for normal, offset in zip(planes[0], planes[1].tolist(), strict=True):
            axis = int(np.argmax(np.abs(normal)))
            first, second = (other for other in range(3) if other != axis)
            distances, measured, target = (np.moveaxis(array, axis, 2) for array in (self.distances, known, filled))
            grid, depth = np.indices(distances.shape[:2]), distances.shape[2]
            rows, columns = grid[0], grid[1]
            # Position of the plane along the axis, in cells.
            level = (offset - normal @ self.origin) / self.cell - normal[first] * rows - normal[second] * columns
            level /= normal[axis]
            nearest = np.rint(level).astype(np.int64)
            inside = (nearest >= 0) & (nearest < depth)
            at = np.clip(nearest, 0, depth - 1)
            error = distances[rows, columns, at] - (at - level) * self.cell * normal[axis]
            seen = inside & measured[rows, columns, at] & (np.abs(error) < 0.7 * self.cell)
            closed = _closed(seen, radius) & inside
            reach = math.ceil(_LIMIT_CELLS / abs(normal[axis]))
            for step in range(-reach, reach + 1):
                here = closed & (nearest + step >= 0) & (nearest + step < depth)
                place = rows[here], columns[here], nearest[here] + step
                distance = ((place[2] - level[here]) * self.cell * normal[axis]).astype(np.float32)
                target[place] = np.minimum(target[place], distance)
        gaps = ~known & (np.abs(filled) <= _LIMIT_CELLS * self.cell)
        self.distances[gaps] = filled[gaps]
        self.weights[gaps] = np.finfo(np.float32).tiny

    def carve(self) -> None:
        """Make cells free where panoramas that look through them outweigh those that measured a surface there."""
        free = self.support < 0
        self.distances[free] = _LIMIT_CELLS * self.cell
        self.weights[free] = np.maximum(self.weights[free], np.finfo(np.float32).tiny)

    def surface(self) -> Surface:
        """Return the surface where all eight cells around a vertex are known.

        A vertex is the mean of the crossings of the edges between these cells.
        """
        inside, known = self.distances < 0, self.weights > 0
        size = [side - 1 for side in inside.shape]
        corners = list(product((0, 1), repeat=3))

        def shifted(array: Mask, corner: tuple[int, ...]) -> Mask:
            return array[tuple(slice(step, step + side) for step, side in zip(corner, size, strict=True))]

        count, complete = np.zeros(size, np.uint8), np.ones(size, np.bool_)
        for corner in corners:
            count += shifted(inside, corner)
            complete &= shifted(known, corner)
        active = complete & (count > 0) & (count < 8)
        del count, complete
        cells = np.argwhere(active)
        number = np.full(size, -1, np.int32)
        number[active] = np.arange(len(cells), dtype=np.int32)
        sums, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
        for corner in corners:
            for axis in (axis for axis in range(3) if not corner[axis]):
                other = np.array(corner) + np.eye(3, dtype=int)[axis]
                start, end = (
                    self.distances[tuple((cells + np.array(step)).T)].astype(np.float64) for step in (corner, other)
                )
                crossed = (start < 0) != (end < 0)
                at = np.broadcast_to(np.array(corner, float), (int(crossed.sum()), 3)).copy()
                at[:, axis] = start[crossed] / (start - end)[crossed]
                sums[crossed] += at
                crossings += crossed
        vertices = self.origin + self.cell * (cells + sums / np.maximum(crossings, 1)[:, None])
        return vertices.astype(np.float32), _quads(inside, number)


def empty_volume(maps: Iterable[tuple[RangeMap, Rigid3]], *, cell: float = 0.0, max_cells: int = MAX_CELLS) -> Volume:
    """Return an empty grid around what panoramas measured.

    `maps`: range maps with their poses. `cell`: width of the cells; 0: the spacing of pixels at the median range, but
    not more than `max_cells` cells.

    Raises:
        InputError: if nothing was measured.
    """
    points, ranges, height = [np.zeros((0, 3))], [np.zeros(0, np.float32)], 1
    for range_map, pose in maps:
        sampled = np.flatnonzero(range_map.confidence >= WEAK_CONFIDENCE[0])[::17]
        ranges.append(range_map.range.ravel()[sampled])
        rays = ray_grid(range_map.range.shape).reshape(-1, 3)[sampled]
        points.append(pose.inverse().apply(rays * ranges[-1][:, None]))
        height = max(height, len(range_map.range))
    if len(measured := np.concatenate(ranges)) < 2:
        raise InputError("no panorama measured a surface: find out why the range maps are empty")
    middle = float(np.median(measured))
    lower, upper = np.percentile(np.concatenate(points), [0.1, 99.9], axis=0)  # without strays
    margin = 0.02 * (upper - lower) + 0.1 * middle
    lower, upper = lower - margin, upper + margin
    width = max(cell or np.pi / height * middle, float(np.prod(upper - lower) / max_cells) ** (1 / 3))
    while np.prod(shape := np.ceil((upper - lower) / width) + 1) > max_cells:
        width *= 1.002
    distances, weights, support = np.zeros((3, *shape.astype(int)), np.float32)
    return Volume(lower, width, distances, weights, support, middle)


def on_planes(surface: Surface, planes: Planes, *, reach: float) -> tuple[NDArray[np.float32], Mask]:
    """Return vertices (V, 3) of a surface that were moved onto planes, and which of them are on one (V,).

    A vertex moves onto a plane that is nearer than `reach` if the surface around it faces as the plane does. Near the
    edges of such parts, vertices within two thirds of it also do: onto the line or the point where planes meet.
    """
    vertices, faces = surface[0].astype(np.float64), surface[1]
    count = len(vertices)
    if not len(planes[1]) or not count:
        return surface[0], np.zeros(count, np.bool_)
    links = adjacency(faces, count)
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.stack([sum(np.bincount(faces[:, c], areas[:, axis], count) for c in range(3)) for axis in range(3)], 1)
    for _ in range(3):
        normals = normals + links @ normals
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    found, order = np.full((count, 3), np.inf), np.zeros((count, 3), np.intp)  # the three nearest planes
    for number, (normal, offset) in enumerate(zip(*planes, strict=True)):
        distance = vertices @ normal - offset
        facing = (np.abs(distance) < reach) & (normals @ normal > 0.9)
        around = facing.astype(np.float32)
        for _ in range(4):
            around = around + links @ around
        near = np.flatnonzero((around >= 3) & (np.abs(distance) < np.where(facing, reach, 2 / 3 * reach)))
        farthest = np.argmax(np.abs(found[near]), axis=1)
        nearer = np.abs(distance[near]) < np.abs(found[near, farthest])
        place = near[nearer], farthest[nearer]
        found[place], order[place] = distance[place[0]], number
    ranks = np.argsort(np.abs(found), axis=1)
    found, order = (np.take_along_axis(array, ranks, axis=1) for array in (found, order))
    system, wanted = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for rank in range(3):
        own = planes[0][order[:, rank]]
        # Of planes that are nearly parallel, the nearest one counts.
        alone = np.isfinite(found[:, rank]) & (np.abs(np.einsum("vri,vi->vr", system, own)) < 0.8).all(axis=1)
        system[alone, rank], wanted[alone, rank] = own[alone], -found[alone, rank]
    moved = system.any(axis=(1, 2))
    vertices[moved] += np.einsum("vir,vr->vi", np.linalg.pinv(system[moved], rcond=1e-3), wanted[moved])
    return vertices.astype(np.float32), np.asarray(moved)


def seen_triangles(surface: Surface, poses: Sequence[Rigid3], kept: Mask, *, threads: int = 1) -> NDArray[np.int32]:
    """Return the triangles of a surface, (F, 3), that a panorama sees, and those near them or vertices that are kept.

    What is left out are back sides of thin surfaces, and noise behind walls.

    `poses`: cam_from_world of the panoramas. `kept`: (V,) vertices that stay. `threads`: number of threads; the result
    does not depend on it.
    """
    vertices, faces = surface
    seen = kept.copy()
    for pose in poses:
        shown = surface_view(vertices, faces, pose, size_hw=(512, 1024), threads=threads).triangle
        seen[faces[np.unique(shown[shown >= 0])]] = True
    links = adjacency(faces, len(vertices))
    for _ in range(3):
        seen |= links @ seen.astype(np.float32) > 0
    return faces[seen[faces].all(axis=1)]


def plane_of_faces(surface: Surface, planes: Planes, *, tolerance: float) -> NDArray[np.int64]:
    """Return the number of the plane on which all corners of each triangle lie, (F,), −1 for none."""
    vertices, faces = surface[0].astype(np.float64), surface[1]
    normals = face_normals(*surface)
    found = np.full(len(faces), -1, np.int64)
    for number, (normal, offset) in enumerate(zip(*planes, strict=True)):
        on = (np.abs(vertices @ normal - offset) <= tolerance)[faces].all(axis=1) & (normals @ normal >= 0.9)
        found[on & (found < 0)] = number
    return found


def adjacency(faces: NDArray[np.int32], count: int) -> scipy.sparse.csr_array:
    """Return which vertices are linked by an edge, (count, count), 1 for an edge."""
    starts, ends = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    both = np.concatenate([starts, ends]), np.concatenate([ends, starts])
    links = scipy.sparse.coo_array((np.ones(2 * len(starts), np.float32), both), shape=(count, count)).tocsr()
    links.data[:] = 1
    return links


def _uncertainty(range_map: RangeMap) -> FloatArray:
    """Return the relative standard deviation of ranges, (H, W), at least half a percent."""
    confirmed = range_map.confidence >= CONSISTENT_CONFIDENCE[0]
    supposed = np.where(confirmed, 0.03, UNCONFIRMED_UNCERTAINTY)
    own = supposed if range_map.uncertainty is None else range_map.uncertainty.astype(np.float64)
    return np.asarray(np.fmax(np.where(np.isnan(own), supposed, own), 0.005))


def _closed(seen: Mask, radius: int) -> Mask:
    """Return a region without gaps narrower than twice a radius, and without holes."""
    padded = np.pad(seen, radius + 1)
    if not seen.any():
        return seen
    grown = scipy.ndimage.distance_transform_edt(~padded) <= radius
    closed = scipy.ndimage.distance_transform_edt(grown) > radius
    inner = slice(radius + 1, -radius - 1)
    return np.asarray(scipy.ndimage.binary_fill_holes(closed | padded)[inner, inner])


def _quads(inside: Mask, number: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the triangles of surface nets: a quad around each edge between cells that are and are not inside."""
    triangles = [np.zeros((0, 3), np.int32)]
    for axis in range(3):
        along = [slice(None)] * 3
        lower, upper = ([*along[:axis], part, *along[axis + 1 :]] for part in (slice(0, -1), slice(1, None)))
        edges = np.argwhere(inside[tuple(lower)] != inside[tuple(upper)])
        first, second = (axis + 1) % 3, (axis + 2) % 3
        limits = np.array(inside.shape) - 1
        edges = edges[((edges > 0) & (edges < limits))[:, [first, second]].all(axis=1)]
        steps = np.zeros((4, 3), int)
        steps[[0, 3], first] = steps[[0, 1], second] = -1
        quads = np.stack([number[tuple((edges + step).T)] for step in steps], axis=1)
        complete = (quads >= 0).all(axis=1)
        outwards = inside[tuple(edges.T)][complete]
        quads = quads[complete]
        quads = np.where(outwards[:, None], quads, quads[:, ::-1])
        triangles += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return np.concatenate(triangles)
