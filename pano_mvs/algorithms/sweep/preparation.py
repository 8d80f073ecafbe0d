"""What a backend is given, and the checks of what it finds.

Pictures are filtered, matched in exposure and converted to grey for census and correlation. The costs of sources are
weighted alike or by parallax. A winner counts where a source sees it and where it has a match, unlike the sky and
surfaces without texture, where all ranges cost about the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.panoramas import contrast_around, filtered
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.sweep.hypotheses import mean_baseline_of, range_at
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pad_panorama, ray_from_pixel, ray_grid, rotate_panorama
from pano_mvs.scene.surfaces import Structure

_ROWS_AT_ONCE = 256


def planes_before(known: Structure, cam_from_world: Rigid3, group: int) -> FloatArray:
    """Return the planes whose front a camera sees as (K, 3) vectors p in its frame, 1/range = p · ray."""
    heights = known.offsets - known.normals_in_world @ cam_from_world.center
    seen = (known.group_idx == group) & (heights < 0)
    return np.asarray(known.normals_in_world[seen] @ cam_from_world.rotation.T / heights[seen, None])


@dataclass(frozen=True, eq=False)
class SweepInput:
    """Everything that a backend needs, checked and prepared.

    Attributes:
        reference: (H, W, C) uint8: grey (C = 1) for census and zncc, RGB for differences.
        sources: the sources likewise, each of its own size.
        source_from_reference: their poses.
        source_valid: for each source, where a sample is valid, (Hs, Ws); None if everywhere in all of them.
        ranges: (D,) float64 depth hypotheses, ascending.
        settings: what was asked for.
        device: where a backend that can choose computes.
        colors: (H, W, 3) uint8 RGB of the reference, the contrast of which is that of `contrast_picture`; or None.
        planes: (K, 3) vectors p in the reference's frame, 1/range = p · ray, of planes that it may show and beyond
            which little lies, for backends that compare windows on them; or None.
    """

    reference: NDArray[np.uint8]
    sources: tuple[NDArray[np.uint8], ...]
    source_from_reference: tuple[Rigid3, ...]
    source_valid: tuple[NDArray[np.bool_], ...] | None
    ranges: NDArray[np.float64]
    settings: SweepSettings
    device: str = "auto"
    colors: NDArray[np.uint8] | None = None
    planes: FloatArray | None = None

    @property
    def contrast_picture(self) -> NDArray[np.uint8]:
        """The picture whose edges penalties and supports follow, (H, W, C): the colours of the reference, if given."""
        return self.reference if self.colors is None else self.colors

    @property
    def baseline(self) -> float:
        """Mean distance of the sources from the reference, for the spacing "parallax"."""
        return mean_baseline_of(self.source_from_reference)

    def range_at(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Return the range at positions between the depth hypotheses, of any shape."""
        settings = self.settings
        return range_at(
            positions,
            float(self.ranges[0]),
            float(self.ranges[-1]),
            planes=settings.planes,
            spacing=settings.spacing,
            baseline=self.baseline,
        )


def prepare_picture(picture: NDArray[np.uint8], settings: SweepSettings) -> NDArray[np.uint8]:
    """Return the picture as it is compared, (H, W, 3) RGB to (H, W, 1) grey or (H, W, 3), prefiltered if asked for."""
    picture = prepare_colors(picture, settings)
    if settings.matching_cost.colors:
        return picture
    grey = np.empty((*picture.shape[:2], 1), np.uint8)
    for first in range(0, len(picture), _ROWS_AT_ONCE):  # 16 bits of all colours at once would be a picture six times
        some = picture[first : first + _ROWS_AT_ONCE].astype(np.uint16)
        luma = np.array([54, 183, 19], np.uint16)  # Rec. 709, in 1/256
        grey[first : first + _ROWS_AT_ONCE, :, 0] = (some @ luma + 128) >> 8
    return grey


def prepare_colors(picture: NDArray[np.uint8], settings: SweepSettings) -> NDArray[np.uint8]:
    """Return the colours of a picture, (H, W, 3) RGB, prefiltered if asked for."""
    diameter, sigmas = settings.prefilter_diameter, (settings.prefilter_sigma_color, settings.prefilter_sigma_space_px)
    if diameter:
        margin = min(diameter, picture.shape[0])
        picture = filtered(picture, margin, lambda padded: cv2.bilateralFilter(padded, diameter, *sigmas))
    return np.ascontiguousarray(picture)


def derotated(
    sources: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], masks: tuple[NDArray[np.bool_], ...] | None
) -> tuple[list[NDArray[np.uint8]], tuple[Rigid3, ...], tuple[NDArray[np.bool_], ...] | None]:
    """Return the sources as the same cameras would see them in the reference's orientation, their poses and masks.

    X_source = R X + t becomes Rᵀ X_source = X + Rᵀ t. A resampled pixel is valid if all that it is made of is.
    """
    turned = [rotate_panorama(source, pose.rotation.T) for source, pose in zip(sources, poses, strict=True)]
    straight = tuple(Rigid3(np.eye(3), pose.rotation.T @ pose.translation) for pose in poses)
    if masks is None:
        return turned, straight, None
    shares = [
        rotate_panorama(mask.astype(np.float64), pose.rotation.T) for mask, pose in zip(masks, poses, strict=True)
    ]
    return turned, straight, tuple(share > 1 - 1e-9 for share in shares)


def pixels_with_valid_window(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """Return the valid pixels of a source around which the whole window is valid too, (H, W).

    A window that looks beyond the mask would compare with the tripod. The window is widened in columns like those of
    the sweep.
    """
    if mask.all() or radius == 0:
        return mask
    height, width = mask.shape
    reach = column_offsets((height, width), radius, spherical=True)[:, -1]
    around = np.pad(reach, radius, mode="symmetric")  # the widest window of all those that look into a row
    reach = np.lib.stride_tricks.sliding_window_view(around, 2 * radius + 1).max(axis=1)
    wide, some_masked = np.zeros_like(mask), ~mask.all(axis=1)
    for columns in np.unique(reach):
        rows = (reach == columns) & some_masked
        if rows.any():
            wide[rows] = _spread_columns(~mask[rows], int(columns))
    padded = pad_panorama(wide, min(radius, height))
    blocked = np.zeros_like(mask)
    for shift in range(2 * radius + 1):
        blocked |= padded[shift : shift + height, radius : radius + width]
    return ~blocked


def _spread_columns(blocked: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    result = blocked.copy()
    for shift in range(1, reach + 1):
        result |= np.roll(blocked, shift, axis=1) | np.roll(blocked, -shift, axis=1)
    return result


def sees_winner(winners: Winners, work: SweepInput) -> NDArray[np.bool_]:
    """Return where at least one source is valid at the plane that won, (H, W)."""
    if work.source_valid is None or any(valid.all() for valid in work.source_valid):
        return np.ones(winners.plane.shape, np.bool_)
    height, width = winners.plane.shape
    seen = np.zeros((height, width), np.bool_)
    for first in range(0, height, _ROWS_AT_ONCE):  # the points of all rows would take gigabytes at 8192×4096
        rows = slice(first, first + _ROWS_AT_ONCE)
        y, x = np.mgrid[first : min(rows.stop, height), 0:width] + 0.5
        rays = ray_from_pixel(np.stack([x, y], axis=-1), (height, width))
        points = rays * work.ranges[winners.plane[rows]][..., None]
        unseen = np.ones(points.shape[:2], np.bool_)
        for pose, valid in zip(work.source_from_reference, work.source_valid, strict=True):
            unseen[unseen] = ~valid_where_seen(valid, pose.apply(points[unseen]))
        seen[rows] = ~unseen
    return seen


def valid_where_seen(valid: NDArray[np.bool_], points_in_source: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the pixel of a source, `valid` (H, W), in which each point (..., 3) is seen is valid, (...,)."""
    return np.asarray(valid[pixels_containing(points_in_source, valid.shape)])


def source_weights(
    size_hw: tuple[int, int], source_from_reference: Sequence[Rigid3], settings: SweepSettings
) -> NDArray[np.float32]:
    """Return the weight of every source at every pixel, (S, H, W), with a sum of 1; (0, 0, 0) if all are equal."""
    if settings.combination != "parallax_weighted":
        return np.zeros((0, 0, 0), np.float32)
    return parallax_weights(size_hw, source_from_reference)


def parallax_weights(size_hw: tuple[int, int], source_from_reference: Sequence[Rigid3]) -> NDArray[np.float32]:
    """Return weights in proportion to the parallax by which a source would notice a change of range, (S, H, W).

    A point at range r along the ray f is seen from a source at C, in the reference's frame, under a direction that
    turns by |f × C| for a unit of 1/r, r ≫ |C|: by the baseline times the sine of the angle between ray and baseline.
    It vanishes at the epipoles, where the source sees the point in the same place at any range.

    `size_hw`: of the reference. `source_from_reference`: pose of each source.
    """
    rays = ray_grid(size_hw)
    parallax = np.stack([np.linalg.norm(np.cross(rays, pose.center), axis=-1) for pose in source_from_reference])
    # Of all weight this share is dealt out equally where no source sees range, so that something is compared at all.
    parallax += 1e-3 * max(float(np.linalg.norm(pose.center)) for pose in source_from_reference) + 1e-12
    return np.asarray(parallax / parallax.sum(axis=0), dtype=np.float32)


def has_match(winners: Winners, work: SweepInput) -> NDArray[np.bool_]:
    """Return where the winner means something, (H, W).

    Limits lie a little outside the scene, so that few surfaces are at a limit. A pixel that runs to the nearest
    planes or to the last one has no match if its surroundings are bare: a chance decided. (Near planes are blurred, and
    so win on bare walls more often than others.) One that runs to the last plane has none either if that plane looks
    the same as infinity: it is the sky, or something that turns with the camera, and any range beyond the last plane
    but one would do as well. Everything else is kept: what is bare between the limits was filled in from its
    surroundings, mostly rightly.
    """
    planes = work.settings.planes
    last = winners.plane == planes - 1
    # The nearest planes are this share of all.
    first = winners.plane < max(1, round(0.03 * planes))
    baseline = max(float(np.linalg.norm(pose.translation)) for pose in work.source_from_reference)
    parallax_px = baseline / work.ranges[-1] * work.reference.shape[1] / (2 * np.pi)
    unmatched = (last | first) & is_bare(work.reference)
    # The last plane is as good as infinitely far if parallax there is less than this.
    if parallax_px < 1.0:
        unmatched |= last
    return np.asarray(~unmatched)


def is_bare(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), around which no colour of a picture (H, W, C) changes enough to be matched."""
    # Grey levels between the darkest and the brightest pixel of a window below which it is bare.
    return contrast_around(picture, 2) < 10
