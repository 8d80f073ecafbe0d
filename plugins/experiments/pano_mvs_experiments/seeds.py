"""Seeds: run the stages that draw random numbers with other ones, to see how much a result depends on chance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from inspect import isfunction, unwrap
from types import CodeType
from typing import Any

from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.workflows.workflow import Workflow

SEED_KEY = "rng_seed"  # the key of a stage in a workflow


def seed_overrides(workflow: Workflow, seed: int) -> list[str]:
    """Return what makes the stages of a workflow draw the numbers of a seed; seed 0 is that of an ordinary run."""
    return [f"{name}.{SEED_KEY}={seed}" for name in drawing_stages(workflow)] if seed else []


def drawing_stages(workflow: Workflow) -> list[str]:
    """Return the names of the stages that draw random numbers."""
    return [name for name, entry in workflow.stages.items() if draws(entry.spec)]


def draws(spec: StageSpec) -> bool:
    """Return whether a stage draws random numbers: whether its code, or a function that takes its context, reads `rng`.

    Functions are found by their names in the module of the stage. If its code is in another environment, any stage
    that takes a context may draw them.
    """
    return "ctx" in spec.extras.values() and (spec.remote is not None or _reads_rng(spec.function, set()))


def _reads_rng(function: Callable[..., Any], seen: set[Callable[..., Any]]) -> bool:
    function = unwrap(function)
    if function in seen or not isfunction(function):
        return False
    seen.add(function)
    names = set(_names(function.__code__))
    if "rng" in names:
        return True
    called = [function.__globals__.get(name) for name in names]
    return any(_reads_rng(other, seen) for other in called if isfunction(other) and _takes_context(other))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _takes_context(function: Callable[..., Any]) -> bool:
    hints = getattr(unwrap(function), "__annotations__", {}).values()
    return any(hint is Context or (isinstance(hint, str) and "Context" in hint) for hint in hints)
