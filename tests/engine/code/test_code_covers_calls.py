"""What a stage executes is in its key: every function of ours that is called while it runs is one that it reaches."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

import pano_mvs
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.testing.stage_calls import StageCase
from tests.engine.code.test_stage_code import as_it_is, functions
from tests.testing.test_builtin_stages import INPUTS, SETTINGS, SIZES_HW

PACKAGE = Path(pano_mvs.__file__).parent
NOT_COUNTED = ("pano_mvs.engine.", "pano_mvs.testing.", "pano_mvs.core.kernel_cache")


@contextmanager
def recorded_calls() -> Iterator[set[CodeType]]:
    """Record the code of every Python function that is called, in all threads."""
    called: set[CodeType] = set()

    def record(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:  # class bodies run at the first import
            called.add(frame.f_code)

    threading.setprofile(record)
    sys.setprofile(record)
    try:
        yield called
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def definition_of(code: CodeType) -> str:
    """Return `module:name` of the top-level definition of ours that some code belongs to; empty for others' code."""
    path = Path(code.co_filename)
    if not path.is_relative_to(PACKAGE) or code.co_name == "<module>":
        return ""
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    return f"{module}:{code.co_qualname.partition('.')[0]}"


@pytest.mark.slow
@pytest.mark.parametrize("stage", sorted(functions()))
def test_a_stage_reaches_what_it_calls(stage: str, tmp_path: Path) -> None:
    spec = Registry.installed().stages[stage]
    case = StageCase(spec, SETTINGS.get(stage, {}), INPUTS.get(stage, {}), SIZES_HW.get(stage, (32, 64)))
    params, arguments = case.params(case.capture), case.arguments(case.capture)
    context = Context(np.random.default_rng(0), tmp_path)
    offered: dict[str, Any] = {"params": params, "ctx": context}
    if spec.list_items is not None:
        offered["item"] = next(iter(spec.list_items(params)))
    extras = {name: offered[role] for name, role in spec.extras.items()}
    # The first kernels of a process look for their cache; some are imported only when a stage runs.
    import_module("pano_mvs.algorithms.ranges.kernels_agreement")
    with recorded_calls() as called, suppress(PanoMvsError):
        spec.function(**arguments, **extras)
    found = {definition_of(code) for code in called} - {""}
    found = {name for name in found if not name.startswith(NOT_COUNTED) and "<" not in name}
    own = f"{spec.function.__module__}:{spec.function.__name__}"
    assert own in found
    assert found - as_it_is()[stage].definitions.keys() == set()
