"""The up direction of a scene, as far as its cameras agree on it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

WORLD_UP: Final = (0.0, -1.0, 0.0)
"""The up direction of a world that nothing has levelled: −y, that of the first camera."""

_MIN_AGREEMENT = 0.5


def mean_up_direction(rotations: ArrayLike) -> NDArray[np.float64] | None:
    """Return the mean of the cameras' own up directions, −y of each camera, in the world.

    Args:
        rotations: (N, 3, 3), camera from world. N may be 0.

    Returns:
        A unit vector (3,), or None if the cameras do not agree: if the mean of the N unit vectors is not longer than
        0.5. For two cameras, that is an angle of 120° or more between their up directions.
    """
    ups = -np.asarray(rotations, np.float64).reshape(-1, 3, 3)[:, 1]
    mean = ups.mean(axis=0) if len(ups) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    return mean / length if length > _MIN_AGREEMENT else None
