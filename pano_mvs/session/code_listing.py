"""The functions whose code counts for each stage of a run, in `logs/code.json`: `diff` names those that changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import read_regular, write_text
from pano_mvs.engine.running.dispatcher import LOG_FOLDER
from pano_mvs.engine.stages.stage_code import code_functions, stage_code
from pano_mvs.engine.workflows.workflow import Workflow

CODE_JSON = "code.json"
_SCHEMA = 2


def write_code_listing(out: Path, workflow: Workflow) -> None:
    """Write the functions that the stages of a workflow use, unless the folder lists them already.

    They only serve to explain differences: if the folder cannot be written, or a file was changed meanwhile, nothing is
    listed.
    """
    with suppress(StoreError, OSError, SyntaxError, ValueError):
        entries = workflow.stages.items()
        digests = {name: stage_code(entry.spec, entry.params).digest for name, entry in entries}
        if _read(out).get("digests") == digests:
            return
        by_stage = {name: code_functions(entry.spec, entry.params) for name, entry in entries}
        # Files of plugins in two folders may have the same name; the functions of a file are one object.
        files = {
            (name, id(functions)): (name, functions) for found in by_stage.values() for name, functions in found.items()
        }
        places = {file: place for place, file in enumerate(files)}
        stages = {
            stage: [places[name, id(functions)] for name, functions in found.items()]
            for stage, found in by_stage.items()
        }
        value = {"schema": _SCHEMA, "digests": digests, "files": list(files.values()), "stages": stages}
        write_text(out / LOG_FOLDER / CODE_JSON, json.dumps(value))


def read_code_listing(out: Path, stage: str, digest: str) -> Mapping[str, Mapping[str, str]]:
    """Return the files that a stage of a run used, each with the digests of its functions; empty if they are unknown.

    Args:
        digest: of the stage's code, as in the identities of its units.
    """
    found = _read(out)
    try:
        if found["digests"][stage] != digest:
            return {}
        files = found["files"]
        return {name: dict(functions) for name, functions in (files[idx] for idx in found["stages"][stage])}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError):
        return {}


def changed_functions(before: Mapping[str, Mapping[str, str]], after: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the functions that differ between two listings, as `FILE: FUNCTIONS`."""
    if not before or not after:
        return []
    found = []
    for file in sorted({*before, *after}):
        one, other = before.get(file), after.get(file)
        if one is None or other is None:
            found.append(f"{file} {'is new' if one is None else 'is no longer used'}")
        elif one != other:
            names = [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]
            found.append(f"{file}: {', '.join(name or 'outside of functions' for name in names)}")
    return found


def _read(out: Path) -> Mapping[str, Any]:
    try:
        found = json.loads(read_regular(out / LOG_FOLDER / CODE_JSON))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and found.get("schema") == _SCHEMA else {}
