"""What computes a sweep and what it compares by: chosen by name, and open to plugins.

A backend turns a `SweepInput` into `Winners`. All backends give the same winners on the same input but for rounding:
`numpy` is the readable one against which the others are held, `numba` the default, `opencv` warps by cv2.remap.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol, TypeVar

from pano_mvs.algorithms.sweep.backends import numpy_backend, opencv_backend
from pano_mvs.algorithms.sweep.costs.registry import BUILTIN_COSTS, SWEEP_COSTS
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.errors import UsageError
from pano_mvs.core.parts import Parts

# By which cost the small sweeps run that find limits and match exposures.
_HELPER_COST, _HELPER_BACKEND = "census", "numba"


class FindWinners(Protocol):
    """What a backend does."""

    def __call__(self, work: SweepInput, /) -> Winners:
        """Return the winning plane of every pixel and the costs around it.

        Raises:
            UsageError: if it cannot do what `work.settings` ask for; the message names what.
        """
        ...


Function = TypeVar("Function", bound=FindWinners)


@dataclass(frozen=True)
class SweepBackend:
    """A backend as it is registered.

    Attributes:
        find_winners: see `FindWinners`.
        costs: the costs that it has; None: any, plugins' too.
    """

    find_winners: FindWinners
    costs: frozenset[str] | None = None


def _numba(work: SweepInput) -> Winners:
    from pano_mvs.algorithms.sweep.backends import numba_backend

    if work.settings.levels > 1:
        from pano_mvs.algorithms.sweep.coarse_to_fine import coarse_to_fine

        return coarse_to_fine.find_winners(work)
    return numba_backend.find_winners(work)


SWEEP_BACKENDS = Parts(
    "sweep backend",
    {
        "numba": SweepBackend(_numba, BUILTIN_COSTS),
        "numpy": SweepBackend(numpy_backend.find_winners),
        "opencv": SweepBackend(opencv_backend.find_winners),
    },
)


def register_sweep_backend(name: str, *, costs: Collection[str] | None = None) -> Callable[[Function], Function]:
    """Declare a function `(work: SweepInput) -> Winners` as the sweep backend of that name.

    Args:
        name: for `backend:` in workflows.
        costs: the names of the costs that it has; None: any, those of other plugins too.

    Raises:
        PluginError: if the name is that of a built-in backend.
    """

    def decorate(function: Function) -> Function:
        known = None if costs is None else frozenset(costs)
        SWEEP_BACKENDS.register(name, SweepBackend(function, known), function)
        return function

    return decorate


def backend_for(name: str, cost: str) -> SweepBackend:
    """Return the backend of that name.

    Raises:
        UsageError: if there is none, or it does not have that cost; the message names those that do.
    """
    backend = SWEEP_BACKENDS.get(name)
    SWEEP_COSTS.check(cost)
    if _has(backend, cost):
        return backend
    able = [other for other in SWEEP_BACKENDS.names() if _has(SWEEP_BACKENDS.get(other), cost)]
    raise UsageError(f"the sweep backend {name!r} does not have the cost {cost!r}; those that do: "
                     f"{', '.join(able) or 'none'}")  # fmt: skip


def check_levels(name: str, levels: int) -> None:
    """Raise UsageError if the backend of that name cannot go from coarse to fine over so many levels."""
    if levels > 1 and name != "numba":
        raise UsageError(f"levels: {levels} needs the sweep backend 'numba', got {name!r}: use it, or levels: 1")


def helper_backend(name: str) -> str:
    """Return the backend for the small sweeps behind a sweep: its own, if it has the cost that they need."""
    return name if _has(SWEEP_BACKENDS.get(name), _HELPER_COST) else _HELPER_BACKEND


def _has(backend: SweepBackend, cost: str) -> bool:
    return backend.costs is None or cost in backend.costs
