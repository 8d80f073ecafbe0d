"""Key points of the network ALIKED on level views of a panorama (Zhao et al., "ALIKED", IEEE TIM 2023)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features.selection import MaxKeypoints, distinct_keypoints, spread_keypoints
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM, PACKAGED, TILE_PX, Array, Networks
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import UP, PinholeView, pixel_from_ray, rotation_from_rotvec, rotation_from_two_vectors
from pano_mvs.scene import Features

_RADIUS_PX = 2  # of the maxima of the network's detector


@checks_settings
def extract_aliked(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    *,
    ups: Sequence[FloatArray],
    max_keypoints: MaxKeypoints = 6000,
    threshold: Annotated[float, Setting("minimum score of a key point", ge=0, le=1)] = 0.01,
    networks: Networks = PACKAGED,
) -> Features:
    """Extract the ALIKED key points of a panorama on two rows of level views around the horizon.

    Views are level because the descriptors do not tolerate a large roll; where several directions may be up, there are
    views for each. Key points that two views of one direction share are one. The last digits of the network's results
    differ between processors, so descriptors are rounded.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool; masked (False) pixels have no key points.
        ups: directions (3,) in the camera frame that may be the zenith, at least one.
        max_keypoints: maximum number of key points for each of `ups`, spread evenly over the sphere.
        networks: the network files and what executes them.

    Raises:
        UsageError: if a network file or the provider is missing.
    """
    size_hw = (image.shape[0], image.shape[1])
    parts = [
        _with_up(image, mask, up, max_keypoints=max_keypoints, threshold=threshold, networks=networks) for up in ups
    ]
    bearings, descriptors, scores = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Features(
        bearings=bearings,
        descriptors=np.rint(DESCRIPTOR_NORM * descriptors).astype(np.float32),
        sizes_rad=np.full(len(bearings), 2 * _RADIUS_PX / FOCAL_PX, np.float32),
        scores=scores,
        colors_rgb=image[_pixels_of(bearings, size_hw)],
        metric="l2",
        size_hw=size_hw,
        learned=len(bearings),
        ups=tuple((float(x), float(y), float(z)) for x, y, z in ups),
        per_up=tuple(len(one) for one, *_ in parts),
    )


def _with_up(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    up: FloatArray,
    *,
    max_keypoints: int,
    threshold: float,
    networks: Networks,
) -> tuple[FloatArray, Array, Array]:
    """Return bearings, unit descriptors and scores of the key points in the views that are level if `up` (3,) is."""
    tiles = level_tiles(up)
    size_hw = (image.shape[0], image.shape[1])
    found = []
    for number, tile in enumerate(tiles):

        def kept(
            pixels: FloatArray, scores: Array, *, number: int = number, tile: PinholeView = tile
        ) -> NDArray[np.intp]:
            bearings = tile.bearings_from_pixels(pixels)
            # Those nearer to the middle of another view are found there.
            nearest = np.argmax([bearings @ other.view_from_cam[2] for other in tiles], axis=0)
            own = np.flatnonzero(mask[_pixels_of(bearings, size_hw)] & (nearest == number))
            # A view with more than this is thinned out below, so most of its key points need no descriptor.
            return own[spread_keypoints(bearings[own], scores[own], max_keypoints=4 * max_keypoints // len(tiles))]

        one = described_tile(
            sample_view(image, tile, interpolation=cv2.INTER_LINEAR), kept, threshold=threshold, networks=networks
        )
        found.append((tile.bearings_from_pixels(one.pixels_px), one.descriptors, one.scores))
    bearings, descriptors, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
    keep = distinct_keypoints(bearings, scores, radius_rad=_RADIUS_PX / FOCAL_PX / 2)
    keep = keep[spread_keypoints(bearings[keep], scores[keep], max_keypoints=max_keypoints)]
    return bearings[keep], descriptors[keep], scores[keep]


class DescribedTile(NamedTuple):
    """Key points of a square picture: pixels (N, 2), (0, 0) its corner; unit descriptors (N, 128); scores (N,)."""

    pixels_px: FloatArray
    descriptors: Array
    scores: Array


def described_tile(
    picture: NDArray[np.uint8],
    kept: Callable[[FloatArray, Array], NDArray[np.intp]],
    *,
    threshold: float,
    networks: Networks,
) -> DescribedTile:
    """Return the key points of a picture of 512 × 512 pixels.

    Args:
        picture: (512, 512, 3) uint8 RGB.
        kept: returns the positions of the key points, pixels (N, 2) and scores (N,), that are described and returned.
        threshold: minimum score.
        networks: the network files and what executes them.
    """
    planes = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
    if extractor := networks.of_colmap("extractor"):
        # Key points of a view that COLMAP's file describes, its own default.
        places, found, strengths = extractor(
            image=planes, max_keypoints=np.array(2048), min_score=np.array(threshold, np.float32)
        )
        # -1 … 1 between the centres of the outermost pixels.
        pixels = (places[0].astype(np.float64) + 1) * ((TILE_PX - 1) / 2)
        keep = kept(pixels + 0.5, strengths[0])
        keep = keep[strengths[0, keep] > threshold]
        return DescribedTile(pixels[keep] + 0.5, found[0, keep], strengths[0, keep])
    score, *maps = networks.load("aliked_detector.onnx")(image=planes)
    pixels, scores = maxima_of_scores(score[0, 0], threshold)
    keep = kept(pixels + 0.5, scores)
    named = {f"features{level}": one for level, one in enumerate(maps)}
    descriptors = networks.load("aliked_descriptor.onnx")(**named, pixels=pixels[keep].astype(np.float32))[0]
    return DescribedTile(pixels[keep] + 0.5, descriptors, scores[keep])


def joined(first: Features, learned: Features) -> Features:
    """Return the key points of another detector followed by those of `extract_aliked`.

    Raises:
        UsageError: if the descriptors of the first are not 128 numbers, as those of SIFT are.
    """
    if first.metric != "l2" or first.descriptors.shape[1] != learned.descriptors.shape[1]:
        raise UsageError("learned key points can only be added to those of features.sift_tangent")
    names = ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(learned, name)]) for name in names}
    return replace(learned, **arrays, size_hw=first.size_hw)


def maxima_of_scores(score: Array, threshold: float) -> tuple[FloatArray, Array]:
    """Return the pixels (N, 2), (0, 0) the first one's centre, and scores (N,) of a map's maxima, as DKD of ALIKED."""
    around = np.ones((2 * _RADIUS_PX + 1, 2 * _RADIUS_PX + 1), np.uint8)
    peaks = score == cv2.dilate(score, around)
    # A maximum may also be lower than a neighbour that another maximum suppresses.
    for _ in range(2):
        suppressed = cv2.dilate(peaks.astype(np.uint8), around) > 0
        rest = np.where(suppressed, np.float32(0), score)
        peaks |= (rest == cv2.dilate(rest, around)) & ~suppressed
    peaks &= score > threshold
    peaks[:_RADIUS_PX] = peaks[-_RADIUS_PX:] = False
    peaks[:, :_RADIUS_PX] = peaks[:, -_RADIUS_PX:] = False
    y, x = np.nonzero(peaks)
    offsets = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    patches = score[(y[:, None] + offsets)[:, :, None], (x[:, None] + offsets)[:, None, :]].astype(np.float64)
    weights = np.exp((patches - patches.max(axis=(1, 2), keepdims=True)) / 0.1)  # the network's temperature
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    shift = np.stack([(weights * offsets).sum(axis=(1, 2)), (weights * offsets[:, None]).sum(axis=(1, 2))], axis=1)
    return np.stack([x, y], axis=1) + shift, score[y, x]


def _pixels_of(bearings: FloatArray, size_hw: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the row and the column of a panorama's pixels that show bearings (N, 3)."""
    x, y = np.floor(pixel_from_ray(bearings, size_hw)).astype(np.intp).T
    return np.minimum(y, size_hw[0] - 1), x % size_hw[1]


FOV_DEG = 60.0
_COLUMNS, _ELEVATIONS_DEG = 8, (-18.0, 18.0)
"""Of two sizes of views, these find twice as many true matches through doors as six of 80° on the horizon."""

FOCAL_PX = TILE_PX / 2 / float(np.tan(np.deg2rad(FOV_DEG) / 2))


def level_tiles(up: FloatArray) -> tuple[PinholeView, ...]:
    """Return two rows of views around the horizon of a camera that sees the zenith in direction `up` (3,)."""
    level_from_cam = rotation_from_two_vectors(up, UP)
    center = np.full(2, TILE_PX / 2)
    return tuple(PinholeView(side @ level_from_cam, FOCAL_PX, center, (TILE_PX, TILE_PX)) for side in _sides())


@lru_cache
def _sides() -> tuple[FloatArray, ...]:
    return tuple(
        rotation_from_rotvec(np.array([np.deg2rad(elevation), 0.0, 0.0]))
        @ rotation_from_rotvec(np.array([0.0, 2 * np.pi * number / _COLUMNS, 0.0]))
        for elevation in _ELEVATIONS_DEG
        for number in range(_COLUMNS)
    )
