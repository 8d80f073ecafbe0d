"""The matching costs of a sweep by name; plugins add their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.windows import column_offsets, neighbours
from pano_mvs.core.errors import ContractError
from pano_mvs.core.parts import Parts

BUILTIN_COSTS = frozenset({"census", "census_gradient", "zncc", "sad", "sad_gradient"})

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class CostWindow:
    """The window around every pixel of the reference, on the sphere: over the seam and over the poles.

    Attributes:
        radius: rows on either side of the centre.
        columns: (H, 2 radius + 1) int64 columns of its pixels against its centre, for a centre in each row.
    """

    radius: int
    columns: NDArray[np.int64]

    @staticmethod
    def of(size_hw: tuple[int, int], radius: int, *, spherical: bool) -> CostWindow:
        """Return the windows of a picture; `spherical` ones are widened towards the poles."""
        return CostWindow(radius, column_offsets(size_hw, radius, spherical=spherical))

    def neighbours(self, picture: NDArray[Scalar]) -> Iterator[NDArray[Scalar]]:
        """Yield, for each place in the window row by row, the picture's pixel there for every centre, (H, W) each."""
        for row in range(-self.radius, self.radius + 1):
            for place in range(2 * self.radius + 1):
                yield neighbours(picture, row, self.columns[:, place])


class CostFunction(Protocol):
    """What a plugin's cost does."""

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
            the support.
        """
        ...


Function = TypeVar("Function", bound=CostFunction)


@dataclass(frozen=True)
class PluginCost:
    """A plugin's cost as it is registered.

    Attributes:
        function: see `CostFunction`.
        colors: whether it compares R, G and B, with their exposures matched, rather than grey values.
    """

    function: CostFunction
    colors: bool = False


SWEEP_COSTS: Parts[PluginCost | None] = Parts("sweep cost", dict.fromkeys(sorted(BUILTIN_COSTS)))
"""All costs; None stands for a built-in one, of which every backend has a version of its own."""


def register_sweep_cost(name: str, *, colors: bool = False) -> Callable[[Function], Function]:
    """Declare a function `(reference, warped, window) -> (H, W)` as the matching cost of that name.

    Backends that take any cost (numpy, opencv) call it once for each source and virtual range.

    Args:
        name: for `cost:` in workflows.
        colors: whether it is given RGB, with exposures matched, rather than grey values.

    Raises:
        PluginError: if the name is that of a built-in cost.
    """

    def decorate(function: Function) -> Function:
        SWEEP_COSTS.register(name, PluginCost(function, colors), function)
        return function

    return decorate


def plugin_cost(name: str) -> PluginCost | None:
    """Return a plugin's cost, or None for a built-in one.

    Raises:
        UsageError: if there is neither.
    """
    return SWEEP_COSTS.get(name)


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
