"""Average the volume of costs among neighbours of similar colour, so that thin objects keep costs of their own.

A box around a pixel of a thin object contains more of what is behind it than of the object. With weights that follow
the colours (K.-J. Yoon and I. S. Kweon, "Adaptive support-weight approach for correspondence search", PAMI 2006), the
average stays within the object. Here it is separable, first along rows and then along columns, and in whole numbers, so
that all backends agree to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import column_offsets, neighbours

_ONE = 256
_PLANES_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class EdgeSupport:
    """The weights of the neighbours of each pixel, which add up to 256.

    `columns`: (H, side) int64 columns of the neighbours in the row, against the pixel. `along`: (side, H, W) uint16
    their weights. `across`: (side, H, W) uint16 weights of the neighbours in the column, from above to below.
    """

    columns: NDArray[np.int64]
    along: NDArray[np.uint16]
    across: NDArray[np.uint16]

    @staticmethod
    def of(work: SweepInput) -> EdgeSupport | None:
        """Return the weights for a sweep; None if it does not average (`edge_support` 1, or no volume)."""
        settings, picture = work.settings, work.contrast_picture
        if settings.edge_support == 1 or settings.aggregation != "sgm":
            return None
        radius = settings.edge_support // 2
        height, width = picture.shape[:2]
        columns = column_offsets((height, width), radius, spherical=settings.spherical_window)
        straight = np.zeros(height, np.int64)
        return EdgeSupport(
            columns,
            _weights([_contrast(picture, 0, columns[:, place]) for place in range(2 * radius + 1)]),
            _weights([_contrast(picture, row, straight) for row in range(-radius, radius + 1)]),
        )

    @property
    def radius(self) -> int:
        """Number of neighbours on either side."""
        return len(self.along) // 2


def average_volume(volume: NDArray[np.uint8], work: SweepInput, *, top: int = 0) -> None:
    """Average a volume of costs in place, where the settings ask for it.

    Args:
        volume: (rows, D, W) of all rows, or of some; beyond its first and last row, rows that are not at a pole count
            as equal to these.
        work: what is swept.
        top: the first row.
    """
    support = EdgeSupport.of(work)
    if support is None:
        return
    from pano_mvs.algorithms.sweep.numba.kernels_edge_support import average_planes  # compiles on import
    from pano_mvs.algorithms.sweep.numba.threads import run_jobs, workers

    rows = slice(top, top + len(volume))
    at_poles = top == 0, rows.stop == support.columns.shape[0]
    along, across = (np.ascontiguousarray(weights[:, rows]) for weights in (support.along, support.across))
    columns = support.columns[rows]

    def average(first: int) -> None:
        average_planes(volume, first, min(_PLANES_AT_ONCE, volume.shape[1] - first), columns, along, across, at_poles)

    with workers() as pool:
        run_jobs(pool, average, range(0, volume.shape[1], _PLANES_AT_ONCE))


def averaged(volume: NDArray[np.int64], work: SweepInput) -> NDArray[np.int64]:
    """Do what `average_volume` does with a whole volume, (H, D, W), plainly, and return it."""
    support = EdgeSupport.of(work)
    if support is None:
        return volume
    straight = np.zeros(len(volume), np.int64)
    planes = []
    for plane in np.moveaxis(volume, 1, 0):
        along = _blended([neighbours(plane, 0, columns) for columns in support.columns.T], support.along)
        rows = range(-support.radius, support.radius + 1)
        planes.append(_blended([neighbours(along, row, straight) for row in rows], support.across))
    return np.stack(planes, axis=1)


def averaged_at(
    costs_at: Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.int64]],
    work: SweepInput,
    *,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> NDArray[np.int64]:
    """Return the costs of some pixels, (D, N), as `average_volume` makes them.

    `costs_at`: returns the costs of the pixels in given rows (N,) and columns (N,), (D, N), before the average. `work`:
    what is swept. `rows`: (N,) of the pixels. `columns`: (N,) likewise.
    """
    support = EdgeSupport.of(work)
    if support is None:
        return costs_at(rows, columns)
    height, width = work.reference.shape[:2]
    places = np.arange(height * width, dtype=np.int64).reshape(height, width)
    straight = np.zeros(height, np.int64)
    down = [neighbours(places, row, straight) for row in range(-support.radius, support.radius + 1)]
    aside = [neighbours(places, 0, offsets) for offsets in support.columns.T]
    above = np.stack([place[rows, columns] for place in down])
    around = np.stack([place.ravel()[above] for place in aside])
    wanted, back = np.unique(around, return_inverse=True)
    costs = costs_at(*np.divmod(wanted, width))[:, back.reshape(around.shape)]
    along = np.moveaxis(costs, 1, 0), support.along.reshape(len(aside), -1)[:, above][:, None]
    mixed = _blended(list(along[0]), along[1])
    return _blended(list(np.moveaxis(mixed, 1, 0)), support.across[:, rows, columns][:, None])


def _blended(costs: list[NDArray[np.int64]], weights: NDArray[np.uint16]) -> NDArray[np.int64]:
    total = sum(cost * weight.astype(np.int64) for cost, weight in zip(costs, weights, strict=True))
    return np.asarray((total + _ONE // 2) // _ONE, np.int64)


def _contrast(picture: NDArray[np.uint8], row: int, columns: NDArray[np.int64]) -> NDArray[np.int16]:
    """Return the largest difference of the channels from the neighbour in another place, (H, W)."""
    channels = [channel.astype(np.int16) for channel in np.moveaxis(picture, -1, 0)]
    return np.asarray(np.max([np.abs(neighbours(one, row, columns) - one) for one in channels], axis=0), np.int16)


def _weights(contrasts: list[NDArray[np.int16]]) -> NDArray[np.uint16]:
    """Return whole weights that add up to 256, (side, H, W); what rounding leaves goes to the pixel itself."""
    # The contrast in grey levels at which a neighbour has half the weight of the pixel itself.
    table = (1 / (1 + (np.arange(256) / 8.0) ** 2)).astype(np.float32)
    weights = np.stack([table[contrast] for contrast in contrasts])
    whole: NDArray[np.uint16] = np.floor(weights * (np.float32(_ONE) / weights.sum(axis=0))).astype(np.uint16)
    middle = len(whole) // 2
    whole[middle] = _ONE - (whole.sum(axis=0, dtype=np.uint16) - whole[middle])
    return whole
