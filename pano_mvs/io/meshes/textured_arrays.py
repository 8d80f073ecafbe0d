"""The arrays of a textured mesh, as writers take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class TexturedArrays(NamedTuple):
    """A mesh with positions in a texture.

    Attributes:
        positions: (N, 3) float32 in the axes of the file.
        uv: (N, 2) float32, (0, 0) the upper-left corner of the texture.
        faces: (F, 3) int32, counter-clockwise as seen from outside.
    """

    positions: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
