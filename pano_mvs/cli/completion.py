"""Shell completion of presets and workflow files, stages, settings and their values.

Completion ignores mistakes in workflows and plugins, which `pano-mvs check` reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.paths import children, is_folder

if TYPE_CHECKING:
    from pano_mvs.engine.workflows.workflow import Workflow

Offer = tuple[str, str]  # what may be put there, and what it is


def _silent(complete: Callable[..., Iterator[Offer]]) -> Callable[..., list[Offer]]:
    """Return a completer that filters by the typed prefix, and returns nothing if an error occurs."""

    def offers(ctx: typer.Context, incomplete: str) -> list[Offer]:
        known = {"ctx": ctx, "incomplete": incomplete}
        wanted = {name: known[name] for name in signature(complete).parameters}
        try:
            return [(text, what) for text, what in complete(**wanted) if text.startswith(incomplete)]
        except (PanoMvsError, OSError):
            return []

    return offers


@_silent
def complete_workflow(incomplete: str) -> Iterator[Offer]:
    """Offer the presets, and workflow files and folders."""
    from pano_mvs.session.session import presets_folder

    for preset in children(presets_folder(), "*.yaml"):
        with preset.open(encoding="utf-8") as stream:
            line = stream.readline().strip()
        yield preset.stem, (line.removeprefix("#").strip() if line.startswith("#") else "preset")
    folder = incomplete.rpartition("/")[0]
    for path in children(Path(f"{folder}/" if folder or incomplete.startswith("/") else ".")):
        shown = f"{folder}/{path.name}" if "/" in incomplete else path.name
        if is_folder(path) and not path.name.startswith("."):
            yield f"{shown}/", "folder"
        elif path.suffix in (".yaml", ".yml"):
            yield shown, "workflow file"


@_silent
def complete_stage_kind() -> Iterator[Offer]:
    """Offer the names of all registered stages."""
    from pano_mvs.engine.stages.registry import Registry

    for name, spec in sorted(Registry.installed().stages.items()):
        yield name, spec.doc.partition("\n")[0]


@_silent
def complete_stage(ctx: typer.Context) -> Iterator[Offer]:
    """Offer the stages of the workflow on the command line, and its groups of stages."""
    workflow = _workflow(ctx)
    if workflow is not None:
        yield from ((name, entry.spec.name) for name, entry in workflow.stages.items())
        yield from ((name, group.description or "group of stages") for name, group in workflow.groups.items())


@_silent
def complete_setting(ctx: typer.Context, incomplete: str) -> Iterator[Offer]:
    """Offer STAGE.PARAM= for the workflow on the command line, and after the sign the values of the setting."""
    target, equals, _ = incomplete.partition("=")
    workflow = _workflow(ctx)
    for name, entry in ({} if workflow is None else workflow.stages).items():
        schema = entry.spec.params_type.model_json_schema(by_alias=True) if entry.spec.params_type.model_fields else {}
        for param, field in schema.get("properties", {}).items():
            setting = f"{name}.{param}"
            if not equals:
                yield f"{setting}=", str(field.get("description", ""))
            elif setting == target:
                yield from ((f"{setting}={value}", "") for value in _values(field))


@_silent
def complete_plugin_kind() -> Iterator[Offer]:
    """Offer the kinds of plugins that can be written."""
    from pano_mvs.cli.plugins.new import KINDS

    for name, kind in KINDS.items():
        yield name, kind.what


def _workflow(ctx: typer.Context) -> Workflow | None:
    from pano_mvs.engine.stages.registry import Registry
    from pano_mvs.engine.workflows.workflow import find_workflow, load_workflow
    from pano_mvs.session.session import presets_folder

    # After an option without its value, click does not process further arguments.
    known = ctx.params.get("workflow") or ctx.params.get("target")
    named = known or next((word for word in ctx.args if not word.startswith("-")), None)
    if not isinstance(named, str):
        return None
    path, _ = find_workflow(named, presets_folder())
    return load_workflow(path, Registry.installed(), presets=presets_folder())


def _values(field: Mapping[str, Any]) -> Iterator[str]:
    """Yield the values of a setting with a fixed set of choices."""
    if field.get("type") == "boolean":
        yield from ("true", "false")
    for option in (field, *field.get("anyOf", ())):
        yield from (str(value) for value in option.get("enum", ()))
        if option.get("type") == "null":
            yield "null"
