"""The texture of a mesh, from panoramas.

Each texel takes its detail from the panorama that sees it best, and its colours at larger scales from all of them by
weight: two bands of P. J. Burt and E. H. Adelson, "A multiresolution spline with application to image mosaics", ACM TOG
2(4), 1983, as M. Brown and D. Lowe use them for panoramas (IJCV 74(1), 2007). Exposures are matched before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Atlas, Texels, texels_of
from pano_mvs.algorithms.mesh.view_quality import PaintView, face_normals, pixel_quality, surface_view
from pano_mvs.algorithms.panoramas import filtered, sharpness
from pano_mvs.core.arrays import FloatArray, FloatImage
from pano_mvs.core.bands import for_bands

_TEXELS_OF_PART = 1 << 20  # bounds the memory


Places = Callable[[NDArray[np.intp]], FloatArray]

_SAMPLES, _NEIGHBOURS = 20_000, 8


def filled_colors(colors: FloatImage, seen: NDArray[np.bool_], places: Places) -> None:
    """Give texels that nobody sees the mean colour of the nearest ones that are seen, by inverse distance, in place.

    Without any, all are grey.

    `colors`: (T, 3) colours of the texels. `seen`: (T,) the texels whose colours are known. `places`: returns the
    places (N, D) of some texels, between which distances are measured.
    """
    known = np.flatnonzero(seen)
    if not len(known):
        colors[:] = 128.0
        return
    known = known[:: -(-len(known) // _SAMPLES)]
    tree = scipy.spatial.cKDTree(places(known))
    hidden = np.flatnonzero(~seen)
    for first in range(0, len(hidden), _TEXELS_OF_PART):
        part = hidden[first : first + _TEXELS_OF_PART]
        distances, nearest = tree.query(places(part), k=range(1, min(_NEIGHBOURS, len(known)) + 1), eps=0.5)
        weights = 1 / np.maximum(distances, 1e-9)
        weights /= weights.sum(axis=1, keepdims=True)
        colors[part] = np.einsum("nk,nkc->nc", weights, colors[known[nearest]])


def spread_over_gaps(texture: NDArray[np.uint8], filled: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return a texture whose other texels have the colour of the nearest filled one.

    Lookups at the borders of charts, and smaller levels of the texture, then mix no foreign colour.

    `texture`: (H, W, 3) or (H, W). `filled`: (H, W) bool.
    """
    if filled.all() or not filled.any():
        return texture
    gaps = np.where(filled, np.uint8(0), np.uint8(1))
    _, labels = cv2.distanceTransformWithLabels(gaps, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(labels.max()) + 1, np.int32)
    source[labels[filled]] = np.flatnonzero(filled)
    flat = texture.reshape(filled.size, -1)
    return np.asarray(flat[source[labels.ravel()]].reshape(texture.shape))


_GAIN_LIMITS = 0.4, 2.5


def view_gains(colors: NDArray[np.float32], weights: NDArray[np.float32]) -> FloatArray:
    """Return the factor of each channel that makes panoramas equally bright, (V, 3).

    The logarithm of a point's colour is modelled as that of the surface plus that of the panorama's exposure; both are
    found alternately, with weights 1 / (1 + (residual / 0.15)²) against moved things and reflections. The mean of the
    logarithms is 0.

    `colors`: (V, P, 3) colours of points as each panorama sees them, 0 to 255. `weights`: (V, P) weights, 0 where a
    panorama does not see the point.
    """
    # Darker or brighter values are clipped or noisy.
    usable = (weights > 0) & (colors.min(axis=-1) > 8.0) & (colors.max(axis=-1) < 247.0)
    usable &= usable.sum(axis=0) > 1
    gains = np.ones((len(colors), 3))
    shared = usable.any(axis=0)
    if not shared.any():
        return gains
    seen = usable[:, shared]
    for channel in range(3):
        logs = np.log(np.maximum(colors[:, shared, channel].astype(np.float64), 1.0))
        exposure = np.zeros(len(logs))
        robust = seen.astype(np.float64)
        for _ in range(30):
            surface = ((logs - exposure[:, None]) * robust).sum(axis=0) / robust.sum(axis=0)
            differences = logs - surface
            # A gain from few points is uncertain: as if this many further points had seen no difference.
            exposure = (differences * robust).sum(axis=1) / (robust.sum(axis=1) + 30.0)
            exposure -= exposure.mean()
            # Differences of the logarithm beyond this are moved things, reflections or wrong ranges.
            residuals = (differences - exposure[:, None]) / 0.15
            robust = seen / (1 + residuals**2)
        gains[:, channel] = np.exp(-exposure)
    return np.clip(gains, *_GAIN_LIMITS)


Loader = Callable[[int], PaintView]

_TEXELS_AT_ONCE = 1 << 13  # of a band; `for_bands` joins 32 of them


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """A mesh with a texture.

    `vertices_in_world`: (V, 3) float32. `faces`: (F, 3) int32. `atlas`: positions in the texture. `texture`: (H, W, 3)
    uint8 RGB. `seen`: (H, W) bool, the texels that a panorama sees; the others are filled with colours from around
    them.
    """

    vertices_in_world: NDArray[np.float32]
    faces: NDArray[np.int32]
    atlas: Atlas
    texture: NDArray[np.uint8]
    seen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class ViewBalance:
    """What makes panoramas comparable.

    `gains`: (V, 3) factors of the colour channels. `worths`: (V,) weight of each panorama by its sharpness, at most 1.
    `density`: pixels per scene unit at which the panoramas see the surface, the upper quartile of all triangles at
    their best.
    """

    gains: NDArray[np.float64]
    worths: NDArray[np.float64]
    density: float


class Surface:
    """A mesh with what its painting needs."""

    def __init__(self, vertices_in_world: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        self.vertices_in_world, self.faces = vertices_in_world, faces
        self.normals = face_normals(vertices_in_world, faces)
        self._size = float(np.ptp(vertices_in_world, axis=0).max()) if len(vertices_in_world) else 1.0

    def places(self, texels: Texels, chosen: NDArray[np.intp]) -> FloatArray:
        """Return positions and scaled normals of texels, (N, 6), so that a floor is far from what stands on it."""
        triangle, weights = texels.triangle[chosen], texels.weights[chosen].astype(np.float64)
        shares = np.stack([1 - weights.sum(axis=1), weights[:, 0], weights[:, 1]], axis=1)
        positions = np.einsum("nc,nci->ni", shares, self.vertices_in_world[self.faces[triangle]])
        return np.concatenate([positions, 0.1 * self._size * self.normals[triangle]], axis=1)

    def looks(
        self, texels: Texels, view: PaintView, *, worth: float, threads: int
    ) -> Callable[[int, int], tuple[FloatImage, FloatImage, FloatImage]]:
        """Return a function of a span of texels that returns weight, colour without detail, and detail of each."""
        from pano_mvs.algorithms.mesh.kernels_mesh import look_at_texels  # compiles on import

        size_hw = view.valid.shape[0], view.valid.shape[1]
        pose = view.cam_from_world
        ranges = surface_view(self.vertices_in_world, self.faces, pose, size_hw=size_hw, threads=threads).ranges
        # Standard deviation, as a share of a panorama's width, of the Gaussian that separates detail from larger
        # scales.
        sigma = size_hw[1] * (1 / 400)
        quality = pixel_quality(view, ranges, feather_px=2.0 * sigma)
        margin = min(int(np.ceil(3 * sigma)), size_hw[0])
        side = 2 * margin + 1
        smooth = np.ascontiguousarray(
            filtered(
                view.picture, margin, lambda padded: cv2.GaussianBlur(padded.astype(np.float32), (side, side), sigma)
            )
        )
        mesh = pose.apply(self.vertices_in_world), self.normals @ pose.rotation.T, self.faces
        # A pixel of a larger panorama covers less of the surface.
        scaled = (quality * np.float32(worth * size_hw[1] ** 2)).astype(np.float32)

        def look(first: int, end: int) -> tuple[FloatImage, FloatImage, FloatImage]:
            count = end - first
            out = np.zeros(count, np.float32), np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
            given = texels.triangle, texels.weights
            look_at_texels(given, mesh, (ranges, scaled, view.picture, smooth), (first, end), out)
            return out

        return look


def balanced_views(
    vertices_in_world: NDArray[np.float32], faces: NDArray[np.int32], load: Loader, *, views: int, threads: int = 1
) -> ViewBalance:
    """Return the exposures and the sharpness of panoramas, and how densely they see a mesh, from reduced copies.

    `vertices_in_world`: (V, 3). `faces`: (F, 3), at least one. `load`: returns a panorama by its index; they are loaded
    one at a time. `views`: number of panoramas. `threads`: number of threads; the result does not depend on it.
    """
    surface = Surface(vertices_in_world, faces)
    corners = vertices_in_world.astype(np.float64)[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # Points that are evenly distributed over the surface.
    count = 20_000
    wanted = (np.arange(count) + 0.5) / count * areas.sum()
    triangle = np.searchsorted(np.cumsum(areas), wanted).clip(0, len(faces) - 1).astype(np.int32)
    first, second = np.random.default_rng(0).random((2, count))
    weights_at = np.stack([1 - np.sqrt(first), np.sqrt(first) * second], axis=1).astype(np.float32)
    centers = Texels(np.arange(count, dtype=np.int32), triangle, weights_at)
    colors = np.zeros((views, len(centers.triangle), 3), np.float32)
    weights = np.zeros((views, len(centers.triangle)), np.float32)
    density, sharp = np.zeros(len(centers.triangle)), np.zeros(views)
    middles = surface.places(centers, np.arange(count))[:, :3]
    for idx in range(views):
        view = load(idx)
        sharp[idx] = sharpness(view.picture)
        look = surface.looks(centers, _reduced(view), worth=1.0, threads=threads)
        weights[idx], base, detail = look(0, len(centers.triangle))
        colors[idx] = base + detail
        distance = np.linalg.norm(middles - view.cam_from_world.center, axis=1)
        pixels = view.picture.shape[1] / (2 * np.pi * np.maximum(distance, 1e-12))
        density = np.maximum(density, np.where(weights[idx] > 0, pixels, 0))
    worths = np.clip(sharp / max(float(np.median(sharp)), 1e-12), 0.25, 1.0) if views else sharp
    seen = density[density > 0]
    return ViewBalance(view_gains(colors, weights), worths, float(np.quantile(seen, 0.75)) if len(seen) else 0.0)


def textured(
    vertices_in_world: NDArray[np.float32],
    faces: NDArray[np.int32],
    atlas: Atlas,
    *,
    load: Loader,
    balance: ViewBalance,
    threads: int = 1,
) -> TexturedMesh:
    """Paint a mesh that was unwrapped.

    `vertices_in_world`: (V, 3). `faces`: (F, 3). `atlas`: of `unwrapped`. `load`: returns a panorama by its index; they
    are loaded one at a time. `balance`: of `balanced_views`. `threads`: number of threads; the result does not depend
    on it.
    """
    texels = texels_of(atlas)
    colors, seen = _painted(Surface(vertices_in_world, faces), texels, load, balance=balance, threads=threads)
    texture, filled, where = np.zeros((*atlas.size_hw, 3), np.uint8), *np.zeros((2, *atlas.size_hw), np.bool_)
    texture.reshape(-1, 3)[texels.pixel], filled.ravel()[texels.pixel] = colors, True
    where.ravel()[texels.pixel] = seen
    del texels, colors
    return TexturedMesh(vertices_in_world, faces, atlas, spread_over_gaps(texture, filled), where)


def _painted(
    surface: Surface, texels: Texels, load: Loader, *, balance: ViewBalance, threads: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the colours (T, 3) of all texels, and which of them a panorama sees."""
    painting = _Painting(len(texels.pixel))
    for idx, (gain, worth) in enumerate(zip(balance.gains, balance.worths, strict=True)):
        look = surface.looks(texels, load(idx), worth=float(worth), threads=threads)
        painting.add(look, gain.astype(np.float32), threads=threads)
    colors, seen = painting.colors()
    filled_colors(colors, seen, lambda chosen: surface.places(texels, chosen))
    np.clip(np.rint(colors, out=colors), 0, 255, out=colors)
    return colors.astype(np.uint8), seen


class _Painting:
    """The colours of texels, panorama after panorama."""

    def __init__(self, count: int) -> None:
        self._sums, self._weights = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        self._best, self._detail = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)

    def add(
        self, look: Callable[[int, int], tuple[FloatImage, FloatImage, FloatImage]], gain: FloatImage, *, threads: int
    ) -> None:
        """Add what one panorama gives."""
        count = len(self._weights)

        def add_band(first_part: int, parts: int) -> None:
            first = first_part * _TEXELS_AT_ONCE
            span = slice(first, min(first + parts * _TEXELS_AT_ONCE, count))
            weight, base, detail = look(span.start, span.stop)
            self._sums[span] += weight[:, None] * (base * gain)
            self._weights[span] += weight
            better = weight > self._best[span]
            self._best[span][better] = weight[better]
            self._detail[span][better] = (detail * gain)[better]

        for_bands(add_band, -(-count // _TEXELS_AT_ONCE), threads=threads)

    def colors(self) -> tuple[FloatImage, NDArray[np.bool_]]:
        """Return the colours (T, 3), and which texels have one."""
        seen = self._weights > 0
        total = np.where(seen, self._weights, np.float32(1))
        np.divide(self._sums, total[:, None], out=self._sums)
        self._sums += self._detail
        return self._sums, seen


def _reduced(view: PaintView) -> PaintView:
    """Return a panorama of at most 512 columns, without its ranges."""
    width = min(512, view.picture.shape[1])
    size = width, width // 2
    picture = cv2.resize(view.picture, size, interpolation=cv2.INTER_AREA)
    valid = cv2.resize(view.valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) == 1
    return PaintView(view.cam_from_world, np.asarray(picture, np.uint8), np.asarray(valid))
