"""Learned key points of an ordinary photograph, and their matches with those of a panorama."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.learned.aliked import described_tile
from pano_mvs.algorithms.learned.lightglue import LightGlue, Side
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM, PACKAGED, TILE_PX, Array, Networks
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.scene import Features


@dataclass(frozen=True, eq=False)
class PhotographView:
    """The learned key points of a photograph, strongest first."""

    pixels_px: NDArray[np.float64]  # (N, 2) float64 in pixels of the photograph as stored, (0, 0) its upper-left corner
    descriptors: Array  # (N, 128) float32 whole numbers, of length `DESCRIPTOR_NORM`
    places: Array  # (N, 2) float32 positions in the square picture that the network saw, −1 … 1 from edge to edge


def view_of_photograph(picture: NDArray[np.uint8], *, networks: Networks = PACKAGED) -> PhotographView:
    """Return the 1,500 strongest ALIKED key points of a photograph, which is reduced or enlarged to 512 pixels.

    Args:
        picture: (H, W, 3) uint8 RGB.
        networks: the network files and what executes them.
    """
    scale = TILE_PX / max(picture.shape[:2])
    size_xy = [max(1, round(side * scale)) for side in picture.shape[1::-1]]
    square = np.zeros((TILE_PX, TILE_PX, 3), np.uint8)
    square[: size_xy[1], : size_xy[0]] = cv2.resize(picture, size_xy, interpolation=cv2.INTER_AREA)
    inside = np.zeros((TILE_PX, TILE_PX), np.bool_)
    inside[: size_xy[1] - 1, : size_xy[0] - 1] = True

    def strongest(pixels: NDArray[np.float64], scores: Array) -> NDArray[np.intp]:
        order = np.argsort(-scores, kind="stable")
        x, y = pixels[order].astype(int).T
        return np.asarray(order[inside[y, x]][:1500])

    tile = described_tile(square, strongest, threshold=0.01, networks=networks)
    pixels = tile.pixels_px
    back = np.array(picture.shape[1::-1]) / np.array(size_xy)
    places = (pixels / (TILE_PX / 2) - 1).astype(np.float32)
    return PhotographView(pixels * back, np.rint(DESCRIPTOR_NORM * tile.descriptors).astype(np.float32), places)


def match_photograph(
    photograph: PhotographView, panorama: Features, *, networks: Networks = PACKAGED
) -> NDArray[np.int32]:
    """Match the learned key points of a photograph and the four most similar level views of a panorama by LightGlue.

    Args:
        photograph: its key points.
        panorama: key points of the panorama, of which only the learned ones are matched.
        networks: the network files and what executes them.

    Returns:
        (M, 2) positions in the photograph's key points and in the panorama's; a key point may have several matches.
    """
    side = Side.of(panorama)
    if min(len(side.descriptors), len(photograph.descriptors)) < 2:
        return np.zeros((0, 2), np.int32)
    nearest = match_l2(photograph.descriptors, side.descriptors, ratio=1)
    counts = (~np.isnan(side.places[:, nearest[:, 1], 0])).sum(axis=1)
    glue = LightGlue(networks)
    seen = photograph.descriptors / np.float32(DESCRIPTOR_NORM), photograph.places
    found = [np.zeros((0, 2), np.int64)]
    for view in np.argsort(-counts, kind="stable")[:4].tolist():
        idx, *shown = side.inside(view)
        matches, _ = glue.match(seen, shown, min_score=0.1)  # as in `match_learned`
        found.append(np.stack([matches[:, 0], idx[matches[:, 1]] + len(panorama) - panorama.learned], axis=1))
    return np.unique(np.concatenate(found), axis=0).astype(np.int32)
