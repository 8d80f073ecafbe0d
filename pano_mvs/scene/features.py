"""Key points of one panorama, as bearings on the sphere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class Features(Record):
    """Key points of one panorama, the strongest of each detector first.

    Attributes:
        bearings: (N, 3) float64 unit rays in the camera frame.
        descriptors: (N, D) float32 (compared by Euclidean distance) or uint8 (compared by Hamming distance).
        sizes_rad: (N,) float32 angular diameter of the patch that was described.
        scores: (N,) float32 strength of the detector's response.
        colors_rgb: (N, 3) uint8 colour of the panorama at the key point.
        metric: "l2" or "hamming".
        size_hw: (height, width) of the panorama in which they were detected.
        learned: number of key points, the last ones, that the network ALIKED found and LightGlue can match.
        up: direction of the zenith in the camera frame, by which the network's views were levelled.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    bearings: NDArray[np.float64]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    sizes_rad: NDArray[np.float32]
    scores: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    metric: Literal["l2", "hamming"]
    size_hw: tuple[int, int]
    learned: int = 0
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)

    def __len__(self) -> int:
        """Return the number of key points."""
        return len(self.bearings)

    def only_learned(self) -> Features:
        """Return the key points that a network found."""
        return self._part(slice(len(self) - self.learned, None), learned=self.learned)

    def without_learned(self) -> Features:
        """Return the key points that no network found."""
        return self._part(slice(0, len(self) - self.learned), learned=0)

    def _part(self, chosen: slice, *, learned: int) -> Features:
        names = ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names}, learned=learned)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree and the bearings are unit vectors."""
        count = len(self.bearings)
        require_array(self, "bearings", dtype=np.float64, shape=(None, 3))
        lengths = np.linalg.norm(self.bearings, axis=1)
        require(bool(np.all(np.abs(lengths - 1) < 1e-6)), self, "bearings must be unit vectors")
        dtype = np.float32 if self.metric == "l2" else np.uint8
        require_array(self, "descriptors", dtype=dtype, shape=(count, None))
        require_array(self, "sizes_rad", dtype=np.float32, shape=(count,))
        require_array(self, "scores", dtype=np.float32, shape=(count,))
        require_array(self, "colors_rgb", dtype=np.uint8, shape=(count, 3))
