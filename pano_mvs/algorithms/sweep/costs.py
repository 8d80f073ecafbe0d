"""The matching costs of a sweep by name, with their plain, readable forms; plugins add their own.

A new built-in cost is a function here with a `SweepCost`, and an entry in `BUILTIN`; the backends numpy and opencv have
it at once. To be compiled, it also needs a number in `kernels_constants` and a branch in `pixel_cost_row`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep import kernels_constants
from pano_mvs.algorithms.sweep.kernels_constants import (
    GREY_WEIGHT,
    MAX_COLOR_COST,
    MAX_GRADIENT_COST,
    ZNCC_NOISE_VARIANCE,
)
from pano_mvs.algorithms.sweep.windows import CostWindow, box_mean, neighbours
from pano_mvs.core.errors import ContractError
from pano_mvs.core.named_registry import NamedRegistry


class CostFunction(Protocol):
    """Computes a cost; a plugin's too."""

    def __call__(
        self, reference: NDArray[np.uint8], warped: NDArray[np.float64], window: CostWindow, /
    ) -> NDArray[np.floating[Any]]:
        """Return what each pixel of the reference costs against the warped source.

        `reference`: (H, W, C) uint8, C = 1 for grey, 3 for colours. `warped`: (H, W, C) what the source shows where the
        reference's rays would end, in whole grey levels. `window`: the window of the settings, around every pixel.

        Returns:
            (H, W) from 0, the same, to 1, as different as can be; ½ is a chance match. The backend averages it over
            the support. (Built-in costs go to `SweepCost.worst` instead of 1.)
        """
        ...


@dataclass(frozen=True)
class SweepCost:
    """A matching cost.

    `name`: for `cost:` in workflows. `function`: the plain, readable form; see `CostFunction`. `colors`: whether it
    compares R, G and B rather than grey values. `minds_exposure`: whether it compares levels as they are, so that
    exposures have to be matched first. `radius`: rows on either side of a pixel that `function` looks at; the result is
    then averaged over the setting `window`. None: it looks at `window`, and the result is averaged over the setting
    `support`. `averages_itself`: whether `function` is given the box and averages by itself, as correlation does.
    `min_window`: the smallest `window` that makes sense. `worst`: the mean cost, by the radius of `window`, that
    semi-global matching takes for the worst there is; half of it is that of a chance match. `kernel`: its number in
    `kernels_constants`; None: it is not compiled.
    """

    name: str
    function: CostFunction
    colors: bool = False
    minds_exposure: bool = False
    radius: int | None = None
    averages_itself: bool = False
    min_window: int = 1
    worst: Callable[[int], float] = lambda _: 1.0
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


def absolute_differences(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], _: CostWindow
) -> NDArray[np.float64]:
    """Return the sum of the absolute differences of all colours, (H, W)."""
    difference: NDArray[np.float64] = np.abs(reference.astype(np.float64) - warped).sum(axis=-1)
    return difference


SAD = SweepCost(
    "sad",
    absolute_differences,
    colors=True,
    minds_exposure=True,
    radius=0,
    worst=lambda _: 96.0,  # in grey levels, summed over R, G and B: a pixel that differs by more is simply wrong
    kernel=kernels_constants.SAD,
)


def sad_gradient_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return the differences of colours and those of their gradients, each truncated, (H, W).

    Gradients are central differences, not halved: over two rows, and over two of the window's columns.
    """
    columns = window.columns[:, window.radius + 1]
    none = np.zeros_like(columns)
    gradient = np.zeros(reference.shape[:2])
    for color in np.moveaxis(reference.astype(np.float64) - warped, -1, 0):
        gradient += np.abs(neighbours(color, 0, columns) - neighbours(color, 0, -columns))
        gradient += np.abs(neighbours(color, 1, none) - neighbours(color, -1, none))
    colors = np.minimum(absolute_differences(reference, warped, window), MAX_COLOR_COST)
    return np.asarray(colors + np.minimum(gradient, MAX_GRADIENT_COST))


SAD_GRADIENT = SweepCost(
    "sad_gradient",
    sad_gradient_cost,
    colors=True,
    minds_exposure=True,
    radius=1,
    worst=lambda _: float(MAX_COLOR_COST + MAX_GRADIENT_COST),
    kernel=kernels_constants.SAD_GRADIENT,
)


def census_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return how many neighbours have another order against the centre in one picture than in the other, (H, W)."""
    ours, theirs = reference[..., 0], warped[..., 0]
    differs = np.zeros(ours.shape)
    for our_neighbour, their_neighbour in zip(window.neighbours(ours), window.neighbours(theirs), strict=True):
        differs += (our_neighbour > ours) != (their_neighbour > theirs)
    return differs


def max_census(radius: int) -> int:
    """Return the number of neighbours in a window."""
    return (2 * radius + 1) ** 2 - 1


CENSUS = SweepCost("census", census_cost, min_window=3, worst=max_census, kernel=kernels_constants.CENSUS)


# Of one colour instead of three, every difference is a third.
_MAX_GREY = GREY_WEIGHT * (MAX_COLOR_COST + MAX_GRADIENT_COST) // 3


def census_weight(radius: int) -> int:
    """Return what a disagreement counts beside grey levels: at worst, all of them four times as much."""
    return 4 * max(1, round(_MAX_GREY / max(1, max_census(radius))))


def census_gradient_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return the census cost plus the differences of grey levels and of their gradients, each truncated, (H, W)."""
    grey = sad_gradient_cost(np.repeat(reference, 3, axis=-1), np.repeat(warped, 3, axis=-1), window) / 3
    return np.asarray(census_weight(window.radius) * census_cost(reference, warped, window) + GREY_WEIGHT * grey)


CENSUS_GRADIENT = SweepCost(
    "census_gradient",
    census_gradient_cost,
    minds_exposure=True,
    min_window=3,
    worst=lambda radius: float(census_weight(radius) * max_census(radius) + _MAX_GREY),
    kernel=kernels_constants.CENSUS_GRADIENT,
)


def zncc_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return 1 − ρ, ρ the correlation over each pixel's window with some noise in both variances, (H, W)."""
    ours, theirs = reference[..., 0].astype(np.float64), warped[..., 0].astype(np.float64)
    mean_r, mean_w = box_mean(ours, window), box_mean(theirs, window)
    variance_r = np.maximum(box_mean(ours**2, window) - mean_r**2, 0) + ZNCC_NOISE_VARIANCE
    variance_w = np.maximum(box_mean(theirs**2, window) - mean_w**2, 0) + ZNCC_NOISE_VARIANCE
    rho = (box_mean(ours * theirs, window) - mean_r * mean_w) / np.sqrt(variance_r * variance_w)
    return np.asarray(1 - np.clip(rho, -1, 1))


ZNCC = SweepCost(
    "zncc", zncc_cost, radius=0, averages_itself=True, min_window=3, worst=lambda _: 2.0, kernel=kernels_constants.ZNCC
)


BUILTIN = {cost.name: cost for cost in (CENSUS, CENSUS_GRADIENT, SAD, SAD_GRADIENT, ZNCC)}
"""The built-in costs by name."""

SWEEP_COSTS: NamedRegistry[SweepCost] = NamedRegistry("sweep cost", BUILTIN)
"""All costs."""

Function = TypeVar("Function", bound=CostFunction)


def register_sweep_cost(name: str, *, colors: bool = False) -> Callable[[Function], Function]:
    """Declare a function `(reference, warped, window) -> (H, W)` as the matching cost of that name.

    Backends that take any cost (numpy, opencv) call it once for each source and depth hypothesis.

    Args:
        name: for `cost:` in workflows.
        colors: whether it is given RGB, with exposures matched, rather than grey values.

    Raises:
        PluginError: if the name is that of a built-in cost.
    """

    def decorate(function: Function) -> Function:
        SWEEP_COSTS.register(name, SweepCost(name, function, colors=colors, minds_exposure=colors), function)
        return function

    return decorate
