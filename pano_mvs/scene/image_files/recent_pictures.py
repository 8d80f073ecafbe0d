"""The pictures that this process decoded last: most units of a run load sources that the unit before loaded too."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from threading import Lock

import numpy as np
from numpy.typing import NDArray


class RecentPictures:
    """Decoded pictures by what they depend on; the least recently used are dropped beyond a number of bytes.

    Args:
        limit_bytes: of all pictures; those of more than a quarter of it are not kept.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._pictures: OrderedDict[Hashable, NDArray[np.uint8]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable) -> NDArray[np.uint8] | None:
        """Return a copy of a picture, or None if it is not there."""
        with self._lock:
            picture = self._pictures.get(key)
            if picture is None:
                return None
            self._pictures.move_to_end(key)
        return picture.copy()

    def put(self, key: Hashable, picture: NDArray[np.uint8]) -> None:
        """Keep a copy of a picture."""
        if 4 * picture.nbytes > self._limit_bytes:
            return
        with self._lock:
            self._pictures[key] = picture.copy()
            self._pictures.move_to_end(key)
            while sum(kept.nbytes for kept in self._pictures.values()) > self._limit_bytes:
                self._pictures.popitem(last=False)
