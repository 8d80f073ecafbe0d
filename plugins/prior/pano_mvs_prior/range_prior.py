"""Ranges of a neural network that sees one panorama, aligned to those that several views measured.

Such a network knows what rooms look like, but neither how large this one is nor, for most networks, the zero of its
values: scale (and shift) are fitted to measured ranges over the whole panorama, as by R. Ranftl et al., "Towards Robust
Monocular Depth Estimation", TPAMI 2022, section 5. What remains differs from surface to surface: the ratio between
measured and aligned ranges is spread within the surfaces of the panorama by the Fast Bilateral Solver.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.data_term import confidence_weight, require_guide
from pano_mvs.algorithms.filters.uncertainty import LEAST_UNCERTAINTY, MOST_UNCERTAINTY, with_ranges
from pano_mvs.algorithms.learned.networks import Network
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, MIRROR_CONFIDENCE, WINDOW_CONFIDENCE

Output: TypeAlias = Literal["range", "inverse_range"]


@checks_settings
def network_values(
    network: Network,
    picture: NDArray[np.uint8],
    *,
    width: Annotated[
        int | None, Setting("columns of the panoramas that the network gets; null: as the file states, or 1024", ge=16)
    ] = None,
    mean: Annotated[
        tuple[float, float, float], Setting("subtracted from red, green and blue in [0, 1]; default: ImageNet's means")
    ] = (0.485, 0.456, 0.406),
    std: Annotated[
        tuple[float, float, float], Setting("what the differences are divided by; default: ImageNet's deviations")
    ] = (0.229, 0.224, 0.225),
) -> NDArray[np.float32]:
    """Return the values of a network for each pixel of a panorama, (H, W).

    Args:
        network: with one input (1, 3, h, w) float32 and a first output of h' × w' values, at any resolution.
        picture: (H, W, 3) RGB panorama.
        width: columns of the panorama that the network gets, with half as many rows, where the file leaves them open.

    Raises:
        UsageError: if the network has another input or output, or a divisor is not positive.
    """
    if not min(std) > 0:
        raise UsageError(f"std must be positive, got {std}")
    name, shape = network.picture_input()
    columns = shape[3] or width or 1024
    rows = shape[2] or columns // 2
    small = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    normalised = (small - np.array(mean, np.float32)) / np.array(std, np.float32)
    values = np.squeeze(network(**{name: np.ascontiguousarray(normalised.transpose(2, 0, 1)[None])})[0])
    if values.ndim != 2:
        raise UsageError(f"the network must return one value per pixel, but its first output is {values.shape}")
    return _resized(values.astype(np.float32), (picture.shape[0], picture.shape[1]))


@checks_settings
def fill_from_prior(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    prior: NDArray[np.float32],
    *,
    output: Annotated[
        Output, Setting("range: values proportional to it; inverse_range: a linear function of 1/range, with any zero")
    ] = "inverse_range",
    valid: Mask | None = None,
    block_deg: Annotated[
        float, Setting("side of the areas left out to measure the error of the network's ranges", gt=0, le=90)
    ] = 10.0,
) -> tuple[RangeMap, float]:
    """Replace ranges that no view saw by those of a network.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.
        prior: (H, W) the network's values; NaN where it has none.
        valid: (H, W) pixels that may have a range; None: all.

    Returns:
        The range map and the relative standard deviation of the network's ranges: their deviation from confirmed ranges
        in areas that were left out of the alignment. It is infinite, and the range map is unchanged, where that is
        not less than the deviation of a constant range. Pixels that other views saw, or that lie on the planes, in
        the mirrors or in the windows of depth.structure, keep their ranges. Others get the network's, with confidence
        3–63; none where the network's are nearer or farther than all measured ones, where the fit was not tested.
    """
    require_guide(guide, range_map)
    known = (range_map.confidence >= FILLED_CONFIDENCE[1]) & np.isfinite(prior)
    weight = confidence_weight(range_map.confidence) * pixel_solid_angle(known.shape)[:, None]
    confirmed = known & (range_map.confidence >= CONSISTENT_CONFIDENCE[0])
    parts = [confirmed & part for part in _halves(known.shape, block_deg)]
    if not all(part.any() for part in parts):
        return range_map, float("inf")
    errors, constants = [], []
    for part, other in zip(parts, reversed(parts), strict=True):
        aligned = _aligned(range_map, guide, prior, weight=np.where(other, weight, 0), output=output).range[part]
        error = np.abs(np.log(aligned / range_map.range[part]))
        errors.append(np.where(np.isfinite(error), error, np.inf))
        constants.append(np.abs(np.log(range_map.range[part] / np.median(range_map.range[other]))))
    # Standard deviations of a normal distribution per median absolute deviation.
    sigma, constant = (1.4826 * float(np.median(np.concatenate(each))) for each in (errors, constants))
    if not sigma < constant:
        return range_map, float("inf")
    laid = _aligned(range_map, guide, prior, weight=np.where(known, weight, 0), output=output)
    panes = MIRROR_CONFIDENCE, WINDOW_CONFIDENCE
    seen = (range_map.confidence >= FILLED_CONFIDENCE[1]) | np.isin(range_map.confidence, panes)
    filled = laid.valid & ~seen & (True if valid is None else valid)
    result = with_ranges(
        range_map,
        np.where(filled, laid.range, range_map.range),
        np.where(filled, laid.confidence, range_map.confidence),
    )
    if result.uncertainty is not None:
        within = np.float16(min(max(sigma, LEAST_UNCERTAINTY), MOST_UNCERTAINTY))
        own = np.where(filled & result.valid, within, result.uncertainty)
        result = replace(result, uncertainty=own)
    return result, sigma


def _aligned(
    range_map: RangeMap, guide: NDArray[np.uint8], prior: NDArray[np.float32], *, weight: FloatArray, output: Output
) -> RangeMap:
    """Return the ranges of a network after alignment to the pixels with a weight; confidences are those of a fill."""
    known = weight > 0
    target = range_map.range[known].astype(np.float64)
    inverse = output == "inverse_range"
    target = 1 / target if inverse else target
    own = prior[known].astype(np.float64)
    relative = np.stack([own, np.full_like(own, inverse)], axis=-1) / target[:, None]
    scale = shift = 0.0
    robust: FloatArray = weight[known]
    for _ in range(20):  # of least absolute relative errors, by weighted squares
        root = np.sqrt(robust)
        scale, shift = np.linalg.lstsq(relative * root[:, None], root, rcond=None)[0]
        # Relative errors below this weigh the same.
        robust = weight[known] / np.maximum(np.abs(relative @ np.array([scale, shift]) - 1), 1e-3)
    values = prior * scale + shift
    inside = (values >= target.min()) & (values <= target.max())
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(inside, 1 / values if inverse else values, np.nan).astype(np.float32)
        ratio = np.where(known, range_map.range / ranges, np.nan).astype(np.float32)
    anchored = np.isfinite(ratio)
    if not anchored.any():
        return RangeMap(np.full_like(ranges, np.nan), np.zeros(ranges.shape, np.uint8))
    spread = fast_bilateral_solver(
        RangeMap(ratio, np.where(anchored, range_map.confidence, np.uint8(0))),
        guide,
        domain="range",
        keep_confidence=256,
        keep_supported=False,
        max_hole_deg=0,
    )
    ranges *= spread.range
    filled = np.minimum(spread.confidence, np.uint8(FILLED_CONFIDENCE[1]))
    return RangeMap(ranges, np.where(np.isfinite(ranges), filled, np.uint8(0)))


def _halves(size_hw: tuple[int, ...], block_deg: float) -> tuple[Mask, Mask]:
    """Return the two colours of a chessboard on the panorama."""
    row = np.floor((np.arange(size_hw[0]) + 0.5) * (180 / size_hw[0]) / block_deg).astype(np.int64)
    column = np.floor((np.arange(size_hw[1]) + 0.5) * (360 / size_hw[1]) / block_deg).astype(np.int64)
    dark = (row[:, None] + column) % 2 == 0
    return dark, ~dark


def _resized(values: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return values of another resolution, interpolated across the seam."""
    if values.shape == size_hw:
        return values
    rows, columns = values.shape
    x = (np.arange(size_hw[1]) + 0.5) * (columns / size_hw[1]) + 0.5  # in a picture with one more column at both sides
    y = np.clip((np.arange(size_hw[0]) + 0.5) * (rows / size_hw[0]) - 0.5, 0, rows - 1)
    wrapped = np.pad(values, ((0, 0), (1, 1)), mode="wrap")
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return np.asarray(cv2.remap(wrapped, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
