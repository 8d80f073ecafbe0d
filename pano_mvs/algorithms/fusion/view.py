"""Views for fusion with the normals of their surfaces, and a cache of the views in use."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import MIRROR_CONFIDENCE


@dataclass(frozen=True, slots=True, eq=False)
class FusionView:
    """One view of a fusion.

    `range_map`: (H, W) range map. `pose`: cam_from_world. `image`: (H, W, 3) uint8 RGB. `mask`: (H, W) bool, False
    where the view is ignored; None: no mask.
    """

    range_map: RangeMap
    pose: Rigid3
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ConfidentView:
    """Data of a view with sufficient confidence, in the memory layout of compiled loops.

    `pose`: cam_from_world. `ranges`: (H, W) float32, NaN if unknown. `confidence`: (H, W) uint8. `image`: (H, W, 3)
    uint8. `normals`: (H, W, 3) float32 normals of the range map, or None. `uncertainty`: (H, W) float32 relative
    standard deviation of the range, that of unconfirmed ranges where it is unknown; or None.
    """

    pose: Rigid3
    ranges: NDArray[np.float32]
    confidence: NDArray[np.uint8]
    image: NDArray[np.uint8]
    normals: NDArray[np.float32] | None
    uncertainty: NDArray[np.float32] | None = None


@lru_cache(maxsize=1)
def held_rays(size_hw: tuple[int, int]) -> NDArray[np.float64]:
    """Return the ray of each pixel, (H, W, 3), read-only; cached, since views of a capture usually have one size."""
    rays = ray_grid(size_hw)
    rays.setflags(write=False)
    return rays


def confident_view(view: FusionView, *, min_confidence: int) -> ConfidentView:
    """Return the data of a view with at least the given confidence, outside of its mask and of mirrors.

    Raises:
        UsageError: if its arrays disagree in size.
    """
    ranges, confidence = view.range_map.range, view.range_map.confidence
    if view.image.shape != (*ranges.shape, 3) or view.image.dtype != np.uint8:
        raise UsageError(
            f"a view's image must be (H, W, 3) uint8 in the size of its range map {ranges.shape}, got "
            f"{view.image.shape} {view.image.dtype}"
        )
    good = (confidence >= min_confidence) & (confidence != MIRROR_CONFIDENCE)
    if view.mask is not None:
        if view.mask.shape != ranges.shape:
            raise UsageError(f"a view's mask must have the size of its range map {ranges.shape}, got {view.mask.shape}")
        good &= view.mask
    given, uncertainty = view.range_map.normals_in_cam, view.range_map.uncertainty
    return ConfidentView(
        view.pose,
        np.where(good, ranges, np.float32(np.nan)),
        np.ascontiguousarray(confidence),
        np.ascontiguousarray(view.image),
        None if given is None else np.where(good[..., None], given, np.float16(np.nan)).astype(np.float32),
        None if uncertainty is None else np.nan_to_num(uncertainty.astype(np.float32), nan=UNCONFIRMED_UNCERTAINTY),
    )


class ViewWindow:
    """Loads views when they are needed and caches the most recent ones."""

    def __init__(self, load: Callable[[int], FusionView], *, min_confidence: int, size: int) -> None:
        """Keep at most `size` views."""
        self._load = load
        self._min_confidence = min_confidence
        self._size = size
        self._held: OrderedDict[int, ConfidentView] = OrderedDict()

    def __getitem__(self, view_idx: int) -> ConfidentView:
        """Return a view, loaded again if it was dropped."""
        if view_idx in self._held:
            self._held.move_to_end(view_idx)
        else:
            while len(self._held) >= self._size:
                self._held.popitem(last=False)
            self._held[view_idx] = confident_view(self._load(view_idx), min_confidence=self._min_confidence)
        return self._held[view_idx]


def nearest_views(poses: Sequence[Rigid3], count: int) -> list[list[int]]:
    """Return for each view the positions of the `count` others with the nearest centres, ascending.

    For equal distances, the earlier view comes first.
    """
    if len(poses) <= count + 1:
        return [[other for other in range(len(poses)) if other != idx] for idx in range(len(poses))]
    centers = np.array([pose.center for pose in poses])
    # A list of ranks, because for k=1 the query drops an axis.
    distances, found = (
        np.asarray(values) for values in scipy.spatial.cKDTree(centers).query(centers, k=list(range(1, count + 2)))
    )
    nearest = []
    for idx in range(len(poses)):
        others = [(distance, other) for distance, other in zip(distances[idx], found[idx], strict=True) if other != idx]
        nearest.append(sorted(int(other) for _, other in sorted(others)[:count]))
    return nearest


def normals_from_range(
    range_map: RangeMap | NDArray[np.float32],
    *,
    given: NDArray[np.float32] | None = None,
    wanted: NDArray[np.bool_] | None = None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Return the unit normal of the surface at each pixel, towards the camera.

    A plane that does not contain the camera's centre is p · X = 1, so on a ray F the inverse range is 1/r = p · F:
    linear in p. p is the weighted least-squares fit over a window, and −p/|p| the normal. The window is measured on the
    sphere: it crosses the seam and the poles, and uses every ⌈1/cos φ⌋-th column, so that it is isotropic. A neighbour
    k steps away whose inverse range differs by more than k · 0.05 is on another surface and has no weight; nearer ones
    have Tukey's biweight of that ratio.

    `range_map`: a range map, or its ranges (H, W) with even W; NaN is invalid. `given`: (H, W, 3) known normals, NaN
    where unknown; None: all unknown. `wanted`: (H, W) pixels at which to fit a plane; None: all. `threads`: number of
    threads; the result does not depend on it.

    Returns:
        (H, W, 3) float32 in the camera frame; NaN if the range is invalid or fewer than 5 pixels of the window are on
        the same surface.

    Raises:
        UsageError: if the ranges are not (H, W) with even W and H ≥ 2.
    """
    from pano_mvs.algorithms.fusion.kernels_fuse import fit_normals  # compiles on import

    ranges = range_map.range if isinstance(range_map, RangeMap) else range_map
    radius = 2  # half the width of the window in pixels at the equator
    if ranges.ndim != 2 or ranges.shape[1] % 2 or ranges.shape[0] < radius:
        raise UsageError(f"normals need ranges (H, W) with even W and H ≥ {radius}, got {ranges.shape}")
    height, width = ranges.shape
    inverse = 1 / ranges.astype(np.float64)
    stretches = columns_per_step((height, width), steps=2 * radius + 1)
    rays = held_rays((height, width))
    at = np.ones((height, width), np.bool_) if wanted is None else wanted
    normals = np.full((height, width, 3), np.nan, np.float32) if given is None else given.astype(np.float32)

    def fit(first: int, rows: int) -> None:
        fit_normals((inverse, rays, at), stretches, radius, 0.05, (first, first + rows), normals)

    for_bands(fit, height, threads=threads)
    return normals
