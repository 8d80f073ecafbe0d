"""The matching costs of a sweep by name; plugins add their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from pano_mvs.algorithms.sweep.costs.census import CENSUS
from pano_mvs.algorithms.sweep.costs.census_gradient import CENSUS_GRADIENT
from pano_mvs.algorithms.sweep.costs.cost import CostFunction, SweepCost
from pano_mvs.algorithms.sweep.costs.sad import SAD
from pano_mvs.algorithms.sweep.costs.sad_gradient import SAD_GRADIENT
from pano_mvs.algorithms.sweep.costs.zncc import ZNCC
from pano_mvs.core.named_registry import NamedRegistry

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
