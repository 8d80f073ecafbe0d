"""Call each built-in stage on the tiny capture, and compare what it makes with what is written down."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pano_mvs.core.errors import PanoMvsError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.testing.stage_calls import StageCase
from tests.golden.summaries import Summary, differences, summary_of
from tests.testing.test_builtin_stages import INPUTS, SETTINGS, SIZES_HW

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
    """Return the names of all cases: the built-in stages, and some with other settings."""
    stages = Registry.installed().stages
    builtin = [name for name in stages if stages[name].function.__module__.startswith("pano_mvs.stages.")]
    return sorted([*builtin, *MORE_CASES])


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
    changes = differences(before.summary, now.summary)
    if not changes:
        return ""
    if (before.code, before.libraries) == (now.code, now.libraries):
        return (
            f"the results of {name} have changed and its key has not: cached results would be served for it. What has "
            "changed is not among the code that the stage reaches (pano_mvs/engine/code), or raise "
            f"KEY_SCHEMA if it is the engine: {'; '.join(changes)}"
        )
    return f"the results of {name} have changed; if they should have, run `{COMMAND}`: {'; '.join(changes)}"


def by_other_libraries(before: Golden | None, now: Golden) -> str:
    """Return which libraries are not those by which a case was recorded: its results may be others then."""
    known = {} if before is None else before.libraries
    changed = {name for name in known.keys() & now.libraries.keys() if known[name] != now.libraries[name]}
    return ", ".join(f"{name} {known[name]} → {now.libraries[name]}" for name in sorted(changed))
