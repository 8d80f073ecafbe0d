"""One vector that sums up a whole panorama, to find pictures of the same place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require_array


@dataclass(frozen=True, eq=False)
class GlobalDescriptor(Record):
    """What a panorama looks like as a whole; two are as alike as the scalar product of their vectors is large.

    Attributes:
        vector: (D,) float32 of about the same length for all pictures; zero for a picture without key points.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    vector: NDArray[np.float32]

    def check(self) -> None:
        """Raise ContractError unless the vector is one of finite numbers."""
        require_array(self, "vector", dtype=np.float32, shape=(None,))
