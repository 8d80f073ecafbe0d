"""What two panoramas agree on: verified matches and their relative pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require_array


@dataclass(frozen=True, eq=False)
class TwoView(Record):
    """The two-view geometry of a pair; falsy, with its reason, where none was found.

    Attributes:
        matches_idx: (M, 2) int32 verified matches: index of the key point in the first and in the second image.
        rotation: (3, 3) float64 of second_from_first.
        direction: (3,) float64 unit translation of second_from_first; its length is unknown.
        residuals_rad: (M,) float32 angular Sampson error of each verified match.
        geometry: "general"; "rotation" (both pictures from the same place: no direction, no range); or "none".
        reason: what is wrong, where the geometry is not general.
        candidates: number of matches before verification.
        parallax_deg: median angle between the two rays of a verified match after de-rotation.
        rotation_std_deg: standard deviation of the rotation about its least certain axis, as far as the matches tell.
        direction_std_deg: the same of the direction; both are 0 unless the geometry is general.
    """

    axis: ClassVar[Axis | None] = Axis.PAIR
    kind_version: ClassVar[int] = 2

    matches_idx: NDArray[np.int32]
    rotation: NDArray[np.float64]
    direction: NDArray[np.float64]
    residuals_rad: NDArray[np.float32]
    geometry: Literal["general", "rotation", "none"]
    reason: str = ""
    candidates: int = 0
    parallax_deg: float = 0.0
    rotation_std_deg: float = 0.0
    direction_std_deg: float = 0.0

    @staticmethod
    def failed(reason: str, *, candidates: int = 0) -> TwoView:
        """Return the falsy value for a pair without geometry."""
        empty = np.zeros((0, 2), np.int32)
        return TwoView(empty, np.eye(3), np.zeros(3), np.zeros(0, np.float32), "none", reason, candidates)

    def __bool__(self) -> bool:
        """Return whether the pair has a general geometry: a rotation and a direction of translation."""
        return self.geometry == "general"

    def __len__(self) -> int:
        """Return the number of verified matches."""
        return len(self.matches_idx)

    @property
    def residual_deg(self) -> float:
        """Median residual of the verified matches; 0 if there are none."""
        return float(np.rad2deg(np.median(self.residuals_rad))) if len(self) else 0.0

    def check(self) -> None:
        """Raise ContractError unless the arrays agree."""
        require_array(self, "matches_idx", dtype=np.int32, shape=(None, 2))
        require_array(self, "rotation", dtype=np.float64, shape=(3, 3))
        require_array(self, "direction", dtype=np.float64, shape=(3,))
        require_array(self, "residuals_rad", dtype=np.float32, shape=(len(self.matches_idx),))
