"""Choose the plane that each pixel of a view shows, or none, by its range, by the pictures, and by its neighbours.

Costs are added along paths in eight directions, on which a change costs less where the colours change (H. Hirschmüller,
"Stereo processing by semiglobal matching and mutual information", TPAMI 2008): plain areas show little, but the edges
around them do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.matched import Mismatch
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

_STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
_NOT_MET = 1e3  # cost of a plane that a pixel does not meet


@dataclass(frozen=True)
class LabelCosts:
    """What labels cost; 1 is that of a mismatch of 1, see `Mismatch`.

    Chosen on two or three views each of three captures and four drawn rooms (`tools.benchmarks.depth.protruding`);
    `more` and `chance` on a rendered house with views 3 m apart.

    Attributes:
        precise: of an own range that is off the plane by the tolerance, for confirmed pixels with texture.
        confirmed: the same for other confirmed pixels.
        textured: for weak ones with texture.
        others: for all others; without texture, weak ranges are right no more often than filled ones.
        outline: of a plane that is not the one of the room's outline, where nothing is confirmed.
        none: of no plane, as a share of the own range's and the outline's.
        advantage: of no plane: own ranges are those that match best, also by chance.
        more: the same in addition where the own range is not confirmed, if views confirm nothing.
        chance: mismatches nearer to 0 than this are chance, if views confirm nothing.
        change: of a change of the label between neighbours of one colour.
        contrast: distance of their colours (Euclidean, RGB, in grey levels) at which a change costs half of that.
        least_share: of the sphere, of a plane that is laid.
    """

    precise: float = 0.6
    confirmed: float = 0.2
    textured: float = 0.2
    others: float = 0.03
    outline: float = 0.2
    none: float = 0.3
    advantage: float = 0.1
    more: float = 0.5
    chance: float = 0.3
    change: float = 8.0
    contrast: float = 3.0
    least_share: float = 0.003


COSTS = LabelCosts()
"""The costs in use."""


def share_of_enough(confidence: NDArray[np.uint8]) -> float:
    """Return the share of the sphere (h, w) that is confirmed, of a half, which is enough; at most 1.

    Views of five rendered houses confirm 10 to 41 % of the sphere, those of the classroom 63 %. Of unconfirmed pixels
    whose ranges are off their plane, 91 % are better on it in nine houses, and 56 % in six captures (`laid.csv`).
    """
    area = pixel_solid_angle((confidence.shape[0], confidence.shape[1]))[:, None] / (4 * np.pi)
    return min(2 * float((area * (confidence >= CONSISTENT_CONFIDENCE[0])).sum()), 1.0)


def plane_labels(
    on_planes: Sequence[FloatArray],
    ranges: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    *,
    outlined: NDArray[np.int64] | None,
    matched: Mismatch | None,
    textured: Mask,
    tolerance: FloatArray,
    guide: Picture,
) -> NDArray[np.int16]:
    """Return the position in `on_planes` of the plane of each pixel of the grid, (h, w), −1 for none.

    Args:
        on_planes: (h, w) range on each plane, NaN where a pixel does not meet it.
        ranges: (h, w) own ranges.
        confidence: (h, w) of these.
        outlined: (h, w) plane of the room's outline, −1 for none; None without one.
        matched: how well the pictures match; None without other views.
        textured: (h, w) whether the picture has texture.
        tolerance: (h, w) relative error of an own range that is on its plane.
        guide: (h, w, 3) RGB.
    """
    confirmed, weak = (confidence >= least[0] for least in (CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE))
    weight = np.select(
        [confirmed & textured, confirmed, weak & textured],
        [COSTS.precise, COSTS.confirmed, COSTS.textured],
        COSTS.others,
    )
    prior = np.zeros(ranges.shape) if outlined is None else COSTS.outline * ((outlined >= 0) & ~confirmed)
    area = pixel_solid_angle((ranges.shape[0], ranges.shape[1]))[:, None] / (4 * np.pi)
    doubt = 1 - share_of_enough(confidence)

    def counted(mismatch: NDArray[np.float32]) -> FloatArray:
        return np.asarray(np.minimum(mismatch + COSTS.chance * doubt, 0.0))

    none = COSTS.none * (weight + prior) + COSTS.advantage + COSTS.more * doubt * ~confirmed
    costs = [(none if matched is None else none + counted(matched.own)).astype(np.float32)]
    numbers = [-1]
    for number, on_plane in enumerate(on_planes):
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.abs(np.log(ranges / on_plane)) / tolerance
        shown = np.zeros(ranges.shape, np.bool_) if outlined is None else outlined == number
        if not (area * ((error < 1) & weak | shown)).sum() >= COSTS.least_share:
            continue
        unknown = np.isfinite(on_plane) & ~np.isfinite(ranges)
        off = np.where(unknown, 0.5, np.minimum(np.nan_to_num(error, nan=1.0), 1.0))
        cost = weight * off + prior * ~shown
        if matched is not None:
            cost += counted(matched.on_planes[number])
        costs.append(np.where(np.isfinite(on_plane), cost, _NOT_MET).astype(np.float32))
        numbers.append(number)
    return np.array(numbers, np.int16)[_cheapest(np.stack(costs, axis=-1), guide)]


def _cheapest(costs: NDArray[np.float32], guide: Picture) -> NDArray[np.intp]:
    """Return the label of each pixel, (h, w), for costs (h, w, L)."""
    from pano_mvs.algorithms.structure.kernels_labels import add_paths  # compiles on import

    colors = guide.astype(np.float32)
    sums = np.zeros(costs.shape, np.float32)
    for step in _STEPS:
        change = np.linalg.norm(colors - np.roll(colors, step, axis=(0, 1)), axis=-1)
        penalties = COSTS.change / (1 + (change / COSTS.contrast) ** 2)
        add_paths(costs, penalties.astype(np.float32), step, sums)
    return np.asarray(sums.argmin(axis=-1), np.intp)
