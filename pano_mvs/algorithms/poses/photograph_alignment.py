"""Refine the camera of a photograph by patches of panoramas, and confirm it by them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.photograph_camera import (
    FocalPrior,
    PhotographCamera,
    Sightings,
    optical_center_offset,
    refine_by_sightings,
)
from pano_mvs.algorithms.poses.photograph_patches import MIN_SIDE_PX, panorama_levels, photograph_levels, sight_points
from pano_mvs.algorithms.poses.photograph_surface import SurfacePoints
from pano_mvs.core.errors import UsageError

_MAX_PHOTOGRAPH_PX, _MAX_PANORAMA_PX = 2048, 2048
# Levels of the panoramas in each round: coarse patches are aligned from further away.
_ROUNDS = (1, 0, 0)


class Aligned(NamedTuple):
    """A camera after alignment."""

    camera: PhotographCamera  # the camera
    confirmed: int  # number of points that the photograph shows where the camera predicts them
    tested: int  # number of points that it could show
    # distance of the optical centre from the middle of the photograph, as a share of the longer side; 0 if it is not
    # significant
    off_center: float = 0.0

    @property
    def share(self) -> float:
        """The share of the tested points that are confirmed."""
        return self.confirmed / max(1, self.tested)


class PanoramaPatches:
    """The panoramas and the points of their surfaces; the panoramas of the last few photographs stay in memory.

    Args:
        surface: returns the points of a panorama by its name.
        load: returns a panorama (H, W, 3) by its name.
    """

    def __init__(self, surface: Callable[[str], SurfacePoints], load: Callable[[str], NDArray[np.uint8]]) -> None:
        self.surface = surface
        self._load = load
        self._held: OrderedDict[str, list[NDArray[np.float32]]] = OrderedDict()

    def levels(self, name: str) -> list[NDArray[np.float32]]:
        """Return the `panorama_levels` of a panorama."""
        if name not in self._held:
            while len(self._held) >= 10:
                self._held.popitem(last=False)
            self._held[name] = panorama_levels(_reduced(self._load(name), _MAX_PANORAMA_PX), max(_ROUNDS) + 1)
        self._held.move_to_end(name)
        return self._held[name]


class PhotographPatches:
    """A photograph that is aligned with panoramas. It is kept in grey, and smoothed when it is needed.

    Args:
        photograph: (H, W, 3) uint8 RGB.
        panoramas: what it is aligned with.
    """

    def __init__(self, photograph: NDArray[np.uint8], panoramas: PanoramaPatches) -> None:
        self._size_hw = (photograph.shape[0], photograph.shape[1])
        self._gray = np.asarray(cv2.cvtColor(_reduced(photograph, _MAX_PHOTOGRAPH_PX), cv2.COLOR_RGB2GRAY), np.uint8)
        self._panoramas = panoramas

    @property
    def too_narrow(self) -> bool:
        """Whether the photograph, reduced to at most 2048 pixels, is narrower or lower than a patch."""
        return bool(min(self._gray.shape) < MIN_SIDE_PX)

    @cached_property
    def _levels(self) -> list[NDArray[np.float32]]:
        return photograph_levels(self._gray)

    def aligned(self, camera: PhotographCamera, names: Iterable[str], *, prior: FocalPrior) -> Aligned:
        """Return the camera that some panoramas' patches confirm best, from one that is accurate to about a degree.

        Args:
            camera: the camera to start from.
            names: the panoramas.
            prior: what is known about the focal length.

        Raises:
            UsageError: if the photograph is too narrow.
        """
        if self.too_narrow:
            raise UsageError(f"the photograph, reduced to {self._gray.shape}, is smaller than a patch")
        chosen, sightings = list(names), Sightings.joined([])
        for level in _ROUNDS:
            sightings = Sightings.joined(
                [
                    sight_points(
                        self._panoramas.surface(name),
                        self._panoramas.levels(name)[level],
                        self._levels,
                        camera=camera,
                        size_hw=self._size_hw,
                    )
                    for name in chosen
                ]
            )
            # With fewer patches than these, the pose is wrong.
            if len(sightings.pixels_px) < max(12, 0.03 * sightings.tested):
                return Aligned(camera, 0, sightings.tested)
            camera = refine_by_sightings(camera, sightings, size_hw=self._size_hw, prior=prior)
        errors = np.linalg.norm(sightings.errors(camera, self._size_hw), axis=1)
        offset, stds = optical_center_offset(camera, sightings, size_hw=self._size_hw, prior=prior)
        significant = float(np.linalg.norm(offset / np.maximum(stds, 1e-9))) > 4.0
        off_center = float(np.linalg.norm(offset)) if significant else 0.0
        return Aligned(camera, int((errors < 3.0).sum()), sightings.tested, off_center)


def _reduced(picture: NDArray[np.uint8], max_px: int) -> NDArray[np.uint8]:
    scale = min(1.0, max_px / max(picture.shape))
    if scale == 1:
        return picture
    size_xy = [max(1, round(side * scale)) for side in picture.shape[1::-1]]
    return np.asarray(cv2.resize(picture, size_xy, interpolation=cv2.INTER_AREA), np.uint8)
