"""Runs in the environment of a plugin: describes its stages, checks their settings and lists the items of its sources.

It is called as `python -m pano_mvs_environments.inside REQUEST ANSWER`, with the paths of two JSON files.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from importlib.metadata import Distribution, EntryPoint, distribution, packages_distributions
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from pano_mvs.api import Record, SourceItem, is_only_planned
from pano_mvs.core.doors import origin_of, own_packages
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.text import error_text, shortened
from pano_mvs.engine.stages.registry import ENTRY_POINT_GROUP, Plugin, Registry
from pano_mvs.engine.stages.stage import StageSpec, place_of
from pano_mvs.engine.stages.stage_code import module_version, package_code
from pano_mvs_environments.settings import UndescribableError, description_of


def main(request: Path, answer: Path) -> None:
    """Answer a request."""
    asked = json.loads(request.read_text(encoding="utf-8"))
    try:
        found = _ANSWERS[asked["do"]](asked)
    except _BrokenError as error:
        found = {"broken": str(error)}
    answer.write_text(json.dumps(found), encoding="utf-8")


def described(request: Mapping[str, Any]) -> dict[str, Any]:
    """Return what another process needs to know about the stages of a distribution, or why it cannot be used."""
    found = distribution(request["distribution"])
    try:
        stages = [_stage(spec) for spec in _stages_of(found)]
    except _RefusedError as error:
        return {"problem": str(error)}
    return {
        "name": found.metadata["Name"],
        "version": found.version,
        "python_version": sys.version.split()[0],
        "stages": stages,
        "libraries": _libraries(all_of_them=request["mode"] == "isolated"),
    }


class _RefusedError(Exception):
    """A plugin that cannot be used from another environment."""


def _stages_of(found: Distribution) -> list[StageSpec]:
    entries = [entry for entry in found.entry_points if entry.group.startswith("pano_mvs.")]
    for entry in entries:
        if entry.group != ENTRY_POINT_GROUP:
            raise _RefusedError(
                f"it offers {entry.name!r} in {entry.group}: a plugin with an environment of its own brings stages "
                "only. Put what is not a stage into a plugin without one"
            )
    if not entries:
        raise _RefusedError(f"it has no entry point in {ENTRY_POINT_GROUP}, which names the module with its stages")
    registry, origin = Registry.installed(), _origin(entries[0], found)
    names: set[str] = set()
    for plugin in (one for one in registry.plugins if one.origin == origin):
        names |= _usable(plugin)
    if clash := next((text for (kind, name), text in registry.clashes.items() if name in names), None):
        raise _RefusedError(clash)
    if not names:
        raise _RefusedError("its modules define no stage: decorate a function with @stage")
    return [registry.stages[name] for name in sorted(names)]


def _origin(entry: EntryPoint, found: Distribution) -> str:
    return origin_of(entry) if entry.dist is not None else f"{found.name} {found.version}"


def _usable(plugin: Plugin) -> set[str]:
    """Return the names of a plugin's stages."""
    if plugin.error:
        raise _RefusedError(f"its code failed to load: {plugin.error}\n{shortened(plugin.trace.rstrip())}")
    for kind, name in plugin.names:
        if kind != "stage":
            raise _RefusedError(
                f"it registers the {kind} {name!r}: a plugin with an environment of its own brings stages only"
            )
    return {name for _, name in plugin.names}


def _stage(spec: StageSpec) -> dict[str, Any]:
    """Return a stage as JSON."""
    if spec.missing:
        packages = ", ".join(spec.missing)
        raise _RefusedError(f"the stage {spec.name} needs {packages}: add this to `dependencies` in its pyproject.toml")
    if spec.memory_needed is not None:
        raise _RefusedError(
            f"the stage {spec.name} declares its memory by a function, which only its own process can call: state the "
            'most that a unit needs, such as memory="2GB"'
        )
    try:
        settings = description_of(spec.params_type)
    except UndescribableError as error:
        raise _RefusedError(f"stage {spec.name}: {error}") from None
    return {
        "name": spec.name,
        "version": spec.version,
        "doc": spec.doc,
        "origin": spec.origin,
        "module": spec.function.__module__,
        "ports": [[port.name, _kind(port.kind, spec), port.cardinality.value, port.optional] for port in spec.ports],
        "output": _kind(spec.output, spec),
        "settings": settings,
        "extras": dict(spec.extras),
        "memory_bytes": spec.memory_bytes,
        "every_image": spec.every_image,
        "is_source": spec.list_items is not None,
        "code": to_jsonable_python(package_code(spec.function.__module__)),
    }


def _kind(kind: type[Record], spec: StageSpec) -> str:
    """Return where a kind is defined, which must be pano_mvs itself."""
    if kind.__module__.partition(".")[0] not in own_packages():
        raise _RefusedError(
            f"the stage {spec.name} reads or returns {kind.kind_name()}, a kind of its own ({kind.__module__}): only "
            "the kinds of pano_mvs.api pass between environments"
        )
    return f"{kind.__module__}:{kind.__qualname__}"


def _libraries(*, all_of_them: bool) -> dict[str, str]:
    """Return the version of each library by module, of those in this environment itself or of all.

    The versions of the others are those of the installation of pano_mvs, which may be updated.
    """
    found = {}
    for module, names in packages_distributions().items():
        if not module.startswith("_") and module not in own_packages():
            places = (Path(str(distribution(name).locate_file(""))) for name in names)
            if all_of_them or any(place.is_relative_to(sys.prefix) for place in places):
                found[module] = module_version(module)
    return found


class _BrokenError(Exception):
    """A stage that was described when the plugin was installed, and cannot be loaded any more."""


def _spec_of(name: str) -> StageSpec:
    registry = Registry.installed()
    if name not in registry.stages:
        raise _BrokenError("; ".join(plugin.error for plugin in registry.broken) or f"it has no stage {name!r}")
    return registry.stages[name]


def checked(request: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is wrong with the settings of a stage, as pydantic says it."""
    spec = _spec_of(request["stage"])
    try:
        spec.params_type.model_validate(request["settings"])
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        return {"problems": [to_jsonable_python(problem) for problem in problems]}
    return {"problems": []}


def listed(request: Mapping[str, Any]) -> dict[str, Any]:
    """Return the items of a source, or why they cannot be listed."""
    spec = _spec_of(request["stage"])
    assert spec.list_items is not None
    is_only_planned.set(request["is_only_planned"])
    try:
        items = list(spec.list_items(spec.params_type.model_validate(request["settings"])))
        return {"items": [_item(item) for item in items]}
    except PanoMvsError as error:
        return {"problem": str(error), "class": type(error).__name__}
    except Exception as error:
        return {"problem": f"{place_of(error, spec)}: {type(error).__name__}: {error_text(error)}", "class": ""}


def _item(item: object) -> dict[str, Any]:
    if not isinstance(item, SourceItem):
        raise TypeError(f"an item is a {type(item).__name__}, not a SourceItem")
    files = {role: str(path.absolute()) for role, path in item.files.items()}
    return {
        "name": item.name,
        "files": files,
        "problem": item.problem,
        "notes": list(item.notes),
        "links": [list(link) for link in item.links],
    }


_ANSWERS: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "describe": described,
    "check": checked,
    "list": listed,
}

if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
