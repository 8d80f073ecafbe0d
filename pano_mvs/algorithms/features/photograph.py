"""SIFT key points of an ordinary photograph, to be compared with those of panoramas."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.tangent import root_sift, sift_detector


@dataclass(frozen=True, slots=True, eq=False)
class PhotographKeypoints:
    """Key points of a photograph, strongest first."""

    pixels_px: NDArray[np.float64]  # (N, 2) float64 in pixels of the photograph as stored, (0, 0) its upper-left corner
    descriptors: NDArray[np.float32]  # (N, 128) float32, RootSIFT as in `extract_sift`


def photograph_keypoints(picture: NDArray[np.uint8], *, max_keypoints: int = 6000) -> PhotographKeypoints:
    """Return the strongest SIFT key points of a photograph.

    Args:
        picture: (H, W, 3) uint8 RGB.
        max_keypoints: maximum number of key points.
    """
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    # Photographs are reduced to this size: panoramas have fewer pixels per degree anyway.
    scale = min(1.0, 1600 / max(gray.shape))
    if scale < 1:
        size_xy = [max(1, round(side * scale)) for side in gray.shape[::-1]]
        gray = cv2.resize(gray, size_xy, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = sift_detector().detectAndCompute(gray, None)
    if descriptors is None:
        return PhotographKeypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    strongest = np.argsort([-k.response for k in keypoints], kind="stable")[:max_keypoints]
    pixels = np.array([keypoints[idx].pt for idx in strongest]).reshape(-1, 2) + 0.5
    back = np.array(picture.shape[1::-1]) / np.array(gray.shape[::-1])
    return PhotographKeypoints(pixels * back, root_sift(descriptors[strongest]))
