"""Further SIFT descriptors of key points, from tiles that are squeezed as if their surfaces were seen obliquely.

A door shows the walls of the next room at angles at which SIFT no longer matches. Images of a surface squeezed in one
direction resemble oblique views of it (ASIFT: Morel & Yu, "A New Framework for Fully Affine Invariant Image
Comparison", 2009). Cameras are mostly level and walls upright, so squeezing horizontally is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features.tangent import SIFT_CLEARANCE, root_sift, sift_detector
from pano_mvs.algorithms.matching.descriptor_layers import DescriptorLayer
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView
from pano_mvs.scene import Features

FloatArray = NDArray[np.float64]

SQUEEZES = 1.0, float(np.sqrt(2.0)), 2.0
_TILES, _FIELD_DEG, _OWNED_DEG = 6, 85.0, 30.5  # tiles along the horizon; key points within 30.5° of their middle
_BLUR = 0.8  # standard deviation in pixels that a squeezed tile would have had before, as in ASIFT
_SNAPPED_PX = 1.0  # at most this far from a key point, at the equator
_MIN_COMPARED = 8
_SAME_KIND = 0.5  # median squared distance of descriptors of one detail, in units of that of different details


@dataclass(frozen=True, slots=True, eq=False)
class SqueezedKeypoints:
    """SIFT key points of tiles along the horizon, all squeezed in the same way.

    Attributes:
        bearings: (N, 3) float64 unit rays in the camera frame.
        descriptors: (N, 128) float32, as OpenCV computes them.
    """

    bearings: FloatArray
    descriptors: NDArray[np.float32]


def squeezed_keypoints(image: NDArray[np.uint8], mask: NDArray[np.bool_], *, squeeze: float) -> SqueezedKeypoints:
    """Return the SIFT key points of six level tiles of 85° around the horizon, each squeezed horizontally.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool; masked (False) pixels and their border have no key points.
        squeeze: width of a tile before, as a multiple of its width after; at least 1.

    Raises:
        UsageError: if the tiles would be stretched.
    """
    if squeeze < 1:
        raise UsageError(f"tiles can be squeezed by 1 or more, not by {squeeze}")
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    valid = None if mask.all() else np.where(mask, np.uint8(255), np.uint8(0))
    detector = sift_detector()
    bearings, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.float32)]
    for turn in range(_TILES):
        tile = _tile(turn, image.shape[1])
        picture = _squeezed(sample_view(gray, tile), squeeze)
        keypoints, described = detector.detectAndCompute(picture, None)
        if described is None:
            continue
        pixels = (np.array([k.pt for k in keypoints]) + 0.5) * (tile.size_hw[1] / picture.shape[1], 1.0)
        rays = tile.bearings_from_pixels(pixels)
        in_view = rays @ tile.view_from_cam.T
        kept = np.abs(np.arctan2(in_view[:, 0], in_view[:, 2])) < np.deg2rad(_OWNED_DEG)
        if valid is not None:
            kept &= _unmasked(valid, tile, pixels, sizes_px=squeeze * np.array([k.size for k in keypoints]))
        bearings.append(rays[kept])
        descriptors.append(described[kept])
    return SqueezedKeypoints(np.concatenate(bearings), np.concatenate(descriptors))


def squeezed_layers(
    features: Features, image: NDArray[np.uint8], mask: NDArray[np.bool_]
) -> tuple[DescriptorLayer, ...]:
    """Return further descriptors of an image's key points, one layer for each squeeze in `SQUEEZES`.

    A key point gets the descriptor of the nearest one of squeezed tiles, if that is within a pixel. Key points that are
    found in squeezed tiles alone are not used: the other images of a room rarely know their ranges.

    Args:
        features: key points of the image.
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool.

    Returns:
        No layers if the descriptors are not those of SIFT, with or without root.
    """
    if features.metric != "l2" or features.descriptors.shape[1] != 128 or not len(features):
        return ()
    tree = cKDTree(features.bearings)
    radius = 2 * np.sin(_SNAPPED_PX * np.pi / image.shape[1])
    described = []
    for squeeze in SQUEEZES:
        found = squeezed_keypoints(image, mask, squeeze=squeeze)
        keypoint_idx, chosen = _snapped(found.bearings, tree, radius)
        described.append((keypoint_idx, found.descriptors[chosen]))
    rooted, plain = ([DescriptorLayer(idx, _whole(kind(d))) for idx, d in described] for kind in (root_sift, np.rint))
    unlikeness = [_unlikeness(features, layers[0]) for layers in (rooted, plain)]
    if min(unlikeness) > _SAME_KIND:
        return ()
    return tuple(rooted if unlikeness[0] <= unlikeness[1] else plain)


def _snapped(bearings: FloatArray, tree: cKDTree, radius: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return key points (M,), ascending, and for each the nearest of the bearings (N, 3) that are nearest to it.

    Args:
        bearings: unit vectors.
        tree: of the key points' bearings.
        radius: largest distance, a chord; key points without a bearing within it are left out.
    """
    distance, owner = (np.asarray(values) for values in tree.query(bearings, distance_upper_bound=radius))
    near = np.flatnonzero(np.isfinite(distance))
    near = near[np.lexsort((near, distance[near], owner[near]))]
    keypoint_idx, first = np.unique(owner[near], return_index=True)
    return keypoint_idx.astype(np.intp), near[first]


def _unlikeness(features: Features, layer: DescriptorLayer) -> float:
    """Return the median squared distance of a layer's descriptors from the key points' own, relative to other ones.

    The layer is that of unsqueezed tiles, so descriptors of the same kind are nearly the same.
    """
    if len(layer) < _MIN_COMPARED:
        return np.inf
    own = features.descriptors[layer.keypoint_idx].astype(np.float64)
    theirs = layer.descriptors.astype(np.float64)
    same, other = (np.median(((own - some) ** 2).sum(axis=1)) for some in (theirs, np.roll(theirs, 1, axis=0)))
    return float(same / other) if other > 0 else np.inf


def _whole(descriptors: NDArray[np.float32]) -> NDArray[np.int16]:
    return np.rint(descriptors).astype(np.int16)


def _tile(turn: int, width: int) -> PinholeView:
    """Return a level tile at the panorama's resolution at its middle."""
    focal_px = width / (2 * np.pi)
    side = max(2, round(2 * focal_px * np.tan(np.deg2rad(_FIELD_DEG / 2))))
    azimuth = turn * 2 * np.pi / _TILES
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    tile_from_cam = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return PinholeView(tile_from_cam, focal_px, np.full(2, side / 2), (side, side))


def _squeezed(picture: NDArray[np.uint8], squeeze: float) -> NDArray[np.uint8]:
    """Return a picture (h, w) with fewer columns, blurred along the rows first to avoid aliasing."""
    if squeeze == 1:
        return picture
    blurred = cv2.GaussianBlur(picture, (0, 0), sigmaX=_BLUR * float(np.sqrt(squeeze**2 - 1)), sigmaY=1e-2)
    size_xy = max(2, round(picture.shape[1] / squeeze)), picture.shape[0]
    return np.asarray(cv2.resize(blurred, size_xy, interpolation=cv2.INTER_LINEAR), np.uint8)


def _unmasked(
    valid: NDArray[np.uint8], tile: PinholeView, pixels_px: FloatArray, *, sizes_px: FloatArray
) -> NDArray[np.bool_]:
    """Return which key points of a tile have no masked pixel within their patch, (N,); `valid` is 255 or 0."""
    seen = (sample_view(valid, tile, interpolation=cv2.INTER_LINEAR) == 255).astype(np.uint8)
    distance_px = cv2.distanceTransform(seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    x, y = np.floor(pixels_px).astype(np.intp).T
    near = distance_px[np.clip(y, 0, tile.size_hw[0] - 1), np.clip(x, 0, tile.size_hw[1] - 1)]
    return np.asarray(near > 1.0 + SIFT_CLEARANCE * sizes_px)
