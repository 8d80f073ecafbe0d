"""The guided filter on the sphere: ranges are, window by window, a linear function of the panorama's colours.

He, Sun and Tang, "Guided Image Filtering", TPAMI 2013, with a colour guide (section 3.5). Each pixel of the data term
is weighted by its confidence, windows keep their solid angle up to the poles, and the seam and the poles are not
borders.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import Domain, data_term, require_guide
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.panoramas import box_spread, box_sum
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import FILLED_CONFIDENCE

# Relative to a window with full weight of all pixels: windows with less weight than this are ignored.
_MIN_SUPPORT = 1e-6


@checks_settings
def guided_range(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    *,
    radius: Annotated[int, Setting("radius of the windows, in pixels at the equator", ge=1)] = 4,
    epsilon: Annotated[float, Setting("contrast in grey levels above which edges are preserved", gt=0)] = 4.0,
    domain: Domain = "inverse",
    fill: Annotated[bool, Setting("fill pixels near valid ones (confidence 3–63)")] = False,
) -> RangeMap:
    """Smooth a range map within the surfaces of the panorama by the guided filter.

    In every window ω the values p are fitted by p ≈ a · I + b, minimising Σ w (a · I + b − p)² + ε² |a|² Σ w, where I
    are the colours and w is `confidence_weight`; a pixel then gets the mean of a and b over the windows that contain
    it, each with its weight. The result is within the range of the given values.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.

    Raises:
        UsageError: if guide and range map differ in size, or a setting is out of bounds.
    """
    height, width = range_map.range.shape
    require_guide(guide, range_map)
    if radius >= height // 2:
        raise UsageError(f"radius must be less than half the height, {height // 2}, got {radius}")
    valid = range_map.valid
    if not valid.any():
        return range_map
    target, weight = data_term(range_map, domain)
    guided = GuidedFilter(weight, guide.astype(np.float64), radius=radius, epsilon=epsilon)
    smooth, support = guided.values(target), guided.support
    kept = support > 0 if fill else valid & (support > 0)
    smooth = np.clip(smooth, target[valid].min(), target[valid].max())
    ranges = np.full((height, width), np.nan, np.float32)
    ranges[kept] = 1 / smooth[kept] if domain == "inverse" else smooth[kept]
    ranges[valid & ~kept] = range_map.range[valid & ~kept]
    low, high = FILLED_CONFIDENCE
    filled = np.where(kept, np.rint(low + (high - low) * np.clip(support, 0, 1)), 0).astype(np.uint8)
    return with_ranges(range_map, ranges, np.where(valid, range_map.confidence, filled))


class GuidedFilter:
    """The guided filter with a guide and weights, for any number of targets."""

    def __init__(self, weight: FloatArray, guide: FloatArray, *, radius: int, epsilon: float) -> None:
        """Measure the windows.

        `weight`: (H, W) in [0, 1]. `guide`: (H, W, 3) colours. `radius`: radius of the windows. `epsilon`: ε.
        """
        self._weight, self._radius = weight[..., None], radius
        # Colours centred on the middle of their scale lose no digits in the differences of sums below.
        self._colors = guide - 128.0
        area, total = box_sum(np.ones_like(weight), radius), box_sum(weight, radius)
        sure = total > _MIN_SUPPORT * area
        self._share = 1 / np.where(sure, total, 1)[..., None]
        self._mean_color = self._share * box_sum(self._weight * self._colors, radius)
        self._cofactors, self._determinant = _cofactors(self._color_covariance(), epsilon**2)
        self._counted = np.where(sure, total / area, 0)
        reach = box_spread(self._counted, radius)
        known = reach > _MIN_SUPPORT * area
        self._reach = np.where(known, reach, 1)[..., None]
        self.support = np.where(known, reach / np.maximum(box_spread(np.ones_like(weight), radius), 1), 0)
        """The mean weight within reach, (H, W)."""

    def values(self, target: FloatArray) -> FloatArray:
        """Return the filtered values, (H, W), arbitrary where there is no support.

        `target`: (H, W) values, any finite value where the weight is 0.
        """
        known = np.concatenate([np.ones_like(self._weight), self._colors], axis=-1) * (self._weight * target[..., None])
        mean, products = np.split(self._share * box_sum(known, self._radius), [1], axis=-1)
        slope = self._solved(products - mean * self._mean_color)
        offset = mean - np.sum(slope * self._mean_color, axis=-1, keepdims=True)
        lines = self._counted[..., None] * np.concatenate([slope, offset], axis=-1)
        averaged = box_spread(lines, self._radius) / self._reach
        return np.asarray(np.sum(averaged[..., :3] * self._colors, axis=-1) + averaged[..., 3])

    def _color_covariance(self) -> FloatArray:
        """Return the weighted covariance of the colours in each window, (H, W, 6): rr, rg, rb, gg, gb, bb."""
        first, second = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
        products = box_sum(self._weight * self._colors[..., first] * self._colors[..., second], self._radius)
        return np.asarray(self._share * products - self._mean_color[..., first] * self._mean_color[..., second])

    def _solved(self, right: FloatArray) -> FloatArray:
        """Return x of (covariance + ε²) x = right, (H, W, 3)."""
        x, y, z = np.moveaxis(right, -1, 0)
        a, b, c, d, e, f = self._cofactors
        solved = np.stack([a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z], axis=-1)
        return np.asarray(solved / self._determinant, np.float64)


def _cofactors(matrix: FloatArray, ridge: float) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Return the cofactors, six of (...,), and the determinant, (..., 1), of (..., 6) upper triangles + ridge."""
    rr, rg, rb, gg, gb, bb = np.moveaxis(matrix, -1, 0)
    rr, gg, bb = rr + ridge, gg + ridge, bb + ridge
    cofactors = (
        gg * bb - gb * gb,
        gb * rb - rg * bb,
        rg * gb - gg * rb,
        rr * bb - rb * rb,
        rb * rg - rr * gb,
        rr * gg - rg * rg,
    )
    return cofactors, (rr * cofactors[0] + rg * cofactors[1] + rb * cofactors[2])[..., None]
