"""The interface of matching costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.core.errors import ContractError


class CostFunction(Protocol):
    """Computes a cost; a plugin's too."""

    def __call__(
        self, reference: NDArray[np.uint8], warped: NDArray[np.float64], window: CostWindow, /
    ) -> NDArray[np.floating[Any]]:
        """Return what each pixel of the reference costs against the warped source.

        Args:
            reference: (H, W, C) uint8, C = 1 for grey, 3 for colours.
            warped: (H, W, C) what the source shows where the reference's rays would end, in whole grey levels.
            window: the window of the settings, around every pixel.

        Returns:
            (H, W) from 0, the same, to 1, as different as can be; ½ is a chance match. The backend averages it over
            the support. (Built-in costs go to `SweepCost.worst` instead of 1.)
        """
        ...


def _one(_: int) -> float:
    return 1.0


@dataclass(frozen=True)
class SweepCost:
    """A matching cost.

    Attributes:
        name: for `cost:` in workflows.
        function: the plain, readable form; see `CostFunction`.
        colors: whether it compares R, G and B rather than grey values.
        minds_exposure: whether it compares levels as they are, so that exposures have to be matched first.
        radius: rows on either side of a pixel that `function` looks at; the result is then averaged over the setting
            `window`. None: it looks at `window`, and the result is averaged over the setting `support`.
        averages_itself: whether `function` is given the box and averages by itself, as correlation does.
        min_window: the smallest `window` that makes sense.
        worst: the mean cost, by the radius of `window`, that semi-global matching takes for the worst there is; half of
            it is that of a chance match.
        kernel: its number in `numba.kernels_constants`; None: it is not compiled.
    """

    name: str
    function: CostFunction
    colors: bool = False
    minds_exposure: bool = False
    radius: int | None = None
    averages_itself: bool = False
    min_window: int = 1
    worst: Callable[[int], float] = _one
    kernel: int | None = None

    def radii(self, *, window: int, support: int) -> tuple[int, int]:
        """Return the radius within which one pixel's cost looks around, and that of the box of the average."""
        return (window // 2, support // 2) if self.radius is None else (self.radius, window // 2)


def checked_cost(cost: NDArray[np.floating[Any]], size_hw: tuple[int, int], name: str) -> NDArray[np.float64]:
    """Return what a plugin's cost returned, (H, W) float64.

    Raises:
        ContractError: if it is of another shape, or not between 0 and 1.
    """
    checked = np.asarray(cost, dtype=np.float64)
    if checked.shape != size_hw or not (checked.min() >= 0 and checked.max() <= 1):
        found = f"{checked.shape} from {checked.min()} to {checked.max()}" if checked.size else f"{checked.shape}"
        raise ContractError(f"the sweep cost {name!r} must return {size_hw} from 0 to 1, got {found}")
    return checked
