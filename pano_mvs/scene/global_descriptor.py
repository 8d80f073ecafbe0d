"""Global image descriptors, which retrieve panoramas of the same place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require_array


@dataclass(frozen=True, eq=False)
class GlobalDescriptor(Record):
    """Global descriptor of a panorama; similar panoramas have vectors with a large scalar product.

    Attributes:
        vector: (D,) float32 of about the same length for all panoramas; zero for a panorama without key points.
        sample: (S, B) int16 descriptors of a few key points; matching them against the sample of
            another panorama identifies neighbours far better than the vectors do. May be empty.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    vector: NDArray[np.float32]
    sample: NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, 0), np.int16))

    def check(self) -> None:
        """Raise ContractError unless the arrays have their shapes and types, and the vector is finite."""
        require_array(self, "vector", dtype=np.float32, shape=(None,))
        require_array(self, "sample", dtype=np.int16, shape=(None, None))
