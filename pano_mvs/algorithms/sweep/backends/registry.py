"""The backends of a sweep by name, with their capabilities; plugins add their own.

A backend turns a `SweepInput` into `Winners`; all backends return the same ones, except for rounding. `numpy` is the
readable one against which the others are tested, `numba` the default; `opencv` warps by cv2.remap.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol, TypeVar

from pano_mvs.algorithms.sweep.backends import numpy_backend, opencv_backend
from pano_mvs.algorithms.sweep.costs import BUILTIN, SWEEP_COSTS
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.errors import UsageError
from pano_mvs.core.named_registry import NamedRegistry

# The cost of the small sweeps that find limits and match exposures, and a backend that has it.
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
    """A backend and what it can do.

    `find_winners`: see `FindWinners`. `costs`: the costs that it has; None: any, plugins' too. `coarse_to_fine`:
    whether it takes `levels` above 1. `bytes_per_voxel`: bytes that semi-global matching takes for each pixel and
    plane. `keeps_volume_limit`: whether it keeps the volume of semi-global matching within `volume_limit_gb`.
    """

    find_winners: FindWinners
    costs: frozenset[str] | None = None
    coarse_to_fine: bool = False
    bytes_per_voxel: int = 3
    keeps_volume_limit: bool = False

    def has_cost(self, name: str) -> bool:
        """Return whether it has a cost."""
        return self.costs is None or name in self.costs

    def volume_bytes(self, pixels: int, settings: SweepSettings) -> int:
        """Return what the volume of semi-global matching takes at most, for a reference of this many pixels.

        From coarse to fine the volume is that of the coarsest level.
        """
        if settings.aggregation != "sgm":
            return 0
        volume = pixels * settings.planes * self.bytes_per_voxel >> 2 * (settings.levels - 1)
        return min(volume, int(settings.volume_limit_gb * 1e9)) if self.keeps_volume_limit else volume


def _numba(work: SweepInput) -> Winners:
    from pano_mvs.algorithms.sweep.backends import numba_backend  # on use: numba is slow to import

    return numba_backend.find_winners(work)


SWEEP_BACKENDS = NamedRegistry(
    "sweep backend",
    {
        "numba": SweepBackend(
            _numba,
            frozenset(name for name, cost in BUILTIN.items() if cost.kernel is not None),
            coarse_to_fine=True,
            keeps_volume_limit=True,
        ),
        "numpy": SweepBackend(numpy_backend.find_winners, bytes_per_voxel=24),
        "opencv": SweepBackend(opencv_backend.find_winners),
    },
)


def register_sweep_backend(
    name: str, *, costs: Collection[str] | None = None, bytes_per_voxel: int = 3
) -> Callable[[Function], Function]:
    """Declare a function `(work: SweepInput) -> Winners` as the sweep backend of that name.

    Args:
        name: for `backend:` in workflows.
        costs: the names of the costs that it has; None: any, those of other plugins too.
        bytes_per_voxel: bytes for each pixel and plane in semi-global matching; runs are planned by it.

    Raises:
        PluginError: if the name is that of a built-in backend.
    """

    def decorate(function: Function) -> Function:
        known = None if costs is None else frozenset(costs)
        SWEEP_BACKENDS.register(name, SweepBackend(function, known, bytes_per_voxel=bytes_per_voxel), function)
        return function

    return decorate


def backend_for(name: str, settings: SweepSettings) -> SweepBackend:
    """Return the backend of that name.

    Raises:
        UsageError: if there is none, or it cannot do what the settings ask for; the message names those that can.
    """
    backend, cost = SWEEP_BACKENDS.get(name), SWEEP_COSTS.check(settings.cost)
    if not backend.has_cost(cost):
        able = _names_of(lambda other: other.has_cost(cost))
        raise UsageError(f"the sweep backend {name!r} does not have the cost {cost!r}; those that do: {able or 'none'}")
    if settings.levels > 1 and not backend.coarse_to_fine:
        able = _names_of(lambda other: other.coarse_to_fine)
        raise UsageError(
            f"levels: {settings.levels} needs the sweep backend {able}, got {name!r}: use it, or levels: 1"
        )
    return backend


def _names_of(able: Callable[[SweepBackend], bool]) -> str:
    return ", ".join(name for name in SWEEP_BACKENDS.names() if able(SWEEP_BACKENDS.get(name)))


def helper_backend(name: str) -> str:
    """Return the backend for the small sweeps behind a sweep: its own, if it has the cost that they need."""
    return name if SWEEP_BACKENDS.get(name).has_cost(_HELPER_COST) else _HELPER_BACKEND
