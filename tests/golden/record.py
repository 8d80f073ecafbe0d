"""Call each stage of ours on the tiny capture, and compare what it makes with what is written down."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.learned import aliked
from pano_mvs.algorithms.learned.aliked import level_tiles
from pano_mvs.core.doors import own_packages
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.scene import FilePart, Record
from pano_mvs.testing.stage_calls import StageCase
from tests.stored import read_picture
from tests.testing.test_builtin_stages import INPUTS, SETTINGS, SIZES_HW

Summary = dict[str, Any]
"""Name to a list of numbers, the count first, or to a text."""

TOLERANCE = 0.03
"""By how much counts, and statistics in units of their spread, may differ between machines."""

_PICTURES = {".png", ".jpg", ".tiff", ".tif"}
_TEXTS = {".json", ".txt", ".csv", ".xml", ".cfg"}
_NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def summary_of(value: Record, metrics: Mapping[str, float]) -> Summary:
    """Return what a stage made, in a few numbers."""
    found: Summary = {"metrics": [float(f"{metrics[name]:.5g}") for name in sorted(metrics)]}
    for name, part in sorted(value.to_parts().items()):
        if isinstance(part, FilePart):
            found |= _of_file(name, part.path)
        elif isinstance(part, np.ndarray):
            found[name] = _of_array(part)
        else:
            leaves = list(_leaves(part))
            found[name] = _of_array(np.array([leaf for leaf in leaves if not isinstance(leaf, str)], np.float64))
            found[f"{name} texts"] = [sum(isinstance(leaf, str) for leaf in leaves)]
    return found


def _of_file(name: str, path: Path) -> Summary:
    if path.suffix in _PICTURES:
        picture = read_picture(path, cv2.IMREAD_UNCHANGED)
        assert picture is not None, path
        return {name: _of_array(picture)}
    data = path.read_bytes()
    if path.suffix in _TEXTS:
        numbers = [float(number) for number in _NUMBER.findall(data.decode())]
        return {name: _of_array(np.array(numbers, np.float64))}
    return {name: [len(data)]}


def _of_array(array: NDArray[Any]) -> list[float]:
    """Return how many values there are, how many of them are finite, and quantiles of those."""
    values = np.asarray(array, np.float64).ravel()
    finite = values[np.isfinite(values)]
    quantiles = np.quantile(finite, _QUANTILES) if len(finite) else np.full(len(_QUANTILES), 0.0)
    mean = finite.mean() if len(finite) else 0.0
    return [len(values), len(finite), *(float(f"{value:.5g}") for value in (mean, *quantiles))]


def _leaves(value: Any) -> Iterator[Any]:
    value = json.loads(json.dumps(value, default=str)) if not isinstance(value, list | dict) else value
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield str(name)
            yield from _leaves(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner)
    elif value is not None:
        yield float(value) if isinstance(value, int | float) else str(value)


def differences(before: Summary, now: Summary, *, tolerance: float = TOLERANCE) -> list[str]:
    """Return what differs between two summaries by more than machines do, in words."""
    return [
        f"{name}: {before.get(name)} → {now.get(name)}"
        for name in sorted({*before, *now})
        if not _alike(before.get(name), now.get(name), tolerance)
    ]


def _alike(before: Any, now: Any, tolerance: float) -> bool:
    if not isinstance(before, list) or not isinstance(now, list) or len(before) != len(now):
        return bool(before == now)
    # The quantiles of an array are compared by how far they lie apart, counts and single figures by their size.
    spread = max(before[-1] - before[-len(_QUANTILES)], 0.0) if len(before) == len(_QUANTILES) + 3 else 0.0
    return all(
        abs(new - old) <= tolerance * max(abs(old), spread) + (2 if idx < 2 and spread else 1e-6)
        for idx, (old, new) in enumerate(zip(before, now, strict=True))
    )


BY_PROCESSOR = {"export.mesh_textured": 0.15}
"""Tolerances of cases whose figures depend on the processor: xatlas cuts 195 charts on one and 185 on another."""

PLACE = Path(__file__).with_name("stages.json")
COMMAND = "python -m tests.golden"
MORE_CASES: Mapping[str, Mapping[str, Any]] = {
    "depth.sweep of the paper": {"cost": "sad", "aggregation": "box", "combination": "sum", "selection": "winner"},
}


@dataclass(frozen=True)
class Golden:
    """What a stage made, and by which code.

    Attributes:
        code: digest of the code that the stage reaches.
        libraries: versions of the libraries that it uses.
        summary: of the result.
    """

    code: str
    libraries: Mapping[str, str]
    summary: Summary


def case_names() -> list[str]:
    """Return the names of all cases: the stages of the core and of the bundled plugins, some with other settings."""
    stages = Registry.installed().stages
    ours = [name for name in stages if stages[name].function.__module__.partition(".")[0] in own_packages()]
    return sorted([*ours, *MORE_CASES])


def made_now(name: str) -> Golden:
    """Return what a case makes now."""
    stage = name.partition(" ")[0]
    spec = Registry.installed().stages[stage]
    settings = {**SETTINGS.get(stage, {}), **MORE_CASES.get(name, {})}
    case = StageCase(spec, settings, INPUTS.get(stage, {}), SIZES_HW.get(stage, (32, 64)))
    params = case.params(case.capture)
    code = stage_code(spec, params)
    with TemporaryDirectory() as scratch:
        context = Context(np.random.default_rng(0), Path(scratch))
        offered: dict[str, Any] = {"params": params, "ctx": context}
        if spec.list_items is not None:
            offered["item"] = next(iter(spec.list_items(params)))
        extras = {name: offered[role] for name, role in spec.extras.items()}
        try:
            # The network of key points looks at three of its 16 views, as in test_builtin_stages.py.
            with patch.object(aliked, "level_tiles", lambda up: level_tiles(up)[:3]):
                value = spec.function(**case.arguments(case.capture), **extras)
        except PanoMvsError as error:
            return Golden(code.digest, code.libraries, {"refused": type(error).__name__})
        return Golden(code.digest, code.libraries, summary_of(value, context.metrics))


def read_recorded(path: Path = PLACE) -> dict[str, Golden]:
    """Return what is written down."""
    return {name: Golden(**value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}


def write_recorded(recorded: Mapping[str, Golden], path: Path = PLACE) -> None:
    """Write it down, one line for each figure, so that a change is easy to see."""
    lines = []
    for name in sorted(recorded):
        one = recorded[name]
        figures = ",\n".join(f"   {json.dumps(key)}: {json.dumps(figure)}" for key, figure in one.summary.items())
        lines.append(
            f' {json.dumps(name)}: {{\n  "code": "{one.code}",\n  "libraries": {json.dumps(dict(one.libraries))},\n'
            f'  "summary": {{\n{figures}\n  }}\n }}'
        )
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def complaint(name: str, before: Golden | None, now: Golden) -> str:
    """Return what is wrong with a case; empty if nothing is."""
    if before is None:
        return f"{name} is not in stages.json yet: run `{COMMAND}`"
    changes = differences(before.summary, now.summary, tolerance=BY_PROCESSOR.get(name, TOLERANCE))
    if not changes:
        return ""
    if (before.code, before.libraries) == (now.code, now.libraries):
        return (
            f"the results of {name} have changed and its key has not: cached results would be served for it. What has "
            "changed is not among the modules that the stage imports (engine/stages/stage_code.py), or raise "
            f"KEY_SCHEMA if it is the engine: {'; '.join(changes)}"
        )
    return f"the results of {name} have changed; if they should have, run `{COMMAND}`: {'; '.join(changes)}"


def by_other_libraries(before: Golden | None, now: Golden) -> str:
    """Return which libraries are not those by which a case was recorded: its results may be others then."""
    known = {} if before is None else before.libraries
    changed = {name for name in known.keys() & now.libraries.keys() if known[name] != now.libraries[name]}
    return ", ".join(f"{name} {known[name]} → {now.libraries[name]}" for name in sorted(changed))
