"""Contract tests of what plugins add to the sweep: costs and backends."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.registry import SWEEP_BACKENDS
from pano_mvs.algorithms.sweep.costs import BUILTIN, SWEEP_COSTS, SweepCost, checked_cost
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.core.errors import UsageError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.testing.contract_test import ContractTest
from pano_mvs.testing.sweep_backends import CASES, agreement, cost_of_case, sweep_case
from pano_mvs.testing.tiny_capture import Variant, tiny_capture

_MIN_AGREEMENT = 0.99
_CASES_TRIED = 5


def cost_contract_tests(cost: Path | str) -> list[ContractTest]:
    """Return the contract tests of a sweep cost, given by name, or of all sweep costs that a plugin file registers.

    Raises:
        UsageError: if the file registers no sweep cost.
    """
    checks = {
        "is from 0 to 1 on images of any size": _cost_is_bounded,
        "is lower where images are the same": _cost_separates_same,
        "is the same when called again and does not modify its inputs": _cost_is_a_function,
    }
    return [
        ContractTest(f"{name} {what}", partial(check, name))
        for name in _names("sweep cost", cost)
        for what, check in checks.items()
    ]


def backend_contract_tests(backend: Path | str, *, device: str = "auto") -> list[ContractTest]:
    """Return the contract tests of a sweep backend; see `cost_contract_tests`.

    A backend must find the same winners as the numpy backend, and the same result when called again.
    """
    return [
        contract_test
        for name in _names("sweep backend", backend)
        for contract_test in (
            ContractTest(f"{name} agrees with the numpy backend", partial(_backend_agrees, name, device)),
            ContractTest(f"{name} returns the same when called again", partial(_backend_is_a_function, name, device)),
        )
    ]


def _cost_is_bounded(name: str) -> None:
    for size_hw in ((8, 16), (9, 18), (25, 50)):
        reference, warped, window = _cost_inputs(name, size_hw)
        checked_cost(_registered(name).function(reference, warped, window), size_hw, name)


def _cost_separates_same(name: str) -> None:
    reference, warped, window = _cost_inputs(name, (32, 64))
    same = _registered(name).function(reference, reference.astype(np.float64), window)
    other = _registered(name).function(reference, warped, window)
    assert same.mean() < 0.5 * other.mean(), (
        f"the cost {name} is {same.mean():.3f} of an image against itself and {other.mean():.3f} against another image"
    )


def _cost_is_a_function(name: str) -> None:
    reference, warped, window = _cost_inputs(name, (25, 50))
    reference.flags.writeable = warped.flags.writeable = False
    first, second = (np.asarray(_registered(name).function(reference, warped, window)).tobytes() for _ in range(2))
    assert first == second, f"the cost {name} returns something else when called again"


def _backend_agrees(name: str, device: str) -> None:
    shares = [agreement(number, name, device=device) for number in _cases(name)]
    mean = float(np.mean(shares))
    assert mean >= _MIN_AGREEMENT, f"{name} agrees with the numpy backend in {mean:.1%} of the pixels"


def _backend_is_a_function(name: str, device: str) -> None:
    number = next(_cases(name))
    first, second = (sweep_case(number).swept(name, device=device) for _ in range(2))
    assert first.range.tobytes() == second.range.tobytes(), f"{name} returns other ranges when called again"


def _cases(name: str) -> Iterator[int]:
    """Yield some cases whose cost the backend supports, spread over all cases."""
    costs = SWEEP_BACKENDS.get(name).costs
    able = [number for number in range(CASES) if costs is None or cost_of_case(number) in costs]
    if not able:
        raise UsageError(f"{name} supports none of the built-in costs, which are needed to compare backends")
    yield from able[:: max(1, len(able) // _CASES_TRIED)]


def _cost_inputs(name: str, size_hw: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float64], CostWindow]:
    """Return two different images as the cost receives them, and windows of 5 × 5 pixels."""
    first, second = (picture.copy() for picture in tiny_capture(Variant(size_hw)).pictures[:2])
    if not _registered(name).colors:
        first, second = first[..., 1:2].copy(), second[..., 1:2].copy()
    return first, second.astype(np.float64), CostWindow.of(size_hw, 2, spherical=True)


def _registered(name: str) -> SweepCost:
    if name in BUILTIN:
        raise UsageError(f"the sweep cost {name!r} is built in: each backend has its own implementation of it")
    return SWEEP_COSTS.get(name)


def _names(kind: str, part: Path | str) -> list[str]:
    if isinstance(part, str):
        return [part]
    registry = Registry()
    registry.add_file(part)
    names = [name for known, name in registry.registrations if known == kind]
    if not names:
        raise UsageError(f"{part} registers no {kind}")
    return names
