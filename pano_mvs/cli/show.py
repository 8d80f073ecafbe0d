"""Show what is registered."""

from __future__ import annotations

import json

from pydantic_core import PydanticUndefined
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.policy import RESERVED_KEYS
from pano_mvs.engine.registry import Registry


def show_plugins(console: Console) -> None:
    """List all stages and where they come from, then the plugins that failed to load."""
    registry = Registry.installed()
    table = Table("stage", "version", "from", "")
    for name, spec in sorted(registry.stages.items()):
        table.add_row(name, str(spec.version), registry.origins[name], spec.doc.splitlines()[0] if spec.doc else "")
    console.print(table)
    for broken in registry.broken:
        console.print(f"[red]broken:[/] {escape(broken.origin)}: {escape(broken.error)}", highlight=False)


def show_stage(name: str, console: Console) -> None:
    """Show a stage's documentation, typed ports and settings.

    Raises:
        UsageError: if there is no such stage.
    """
    registry = Registry.installed()
    spec = registry.stages.get(name)
    if spec is None:
        raise UsageError(f"there is no stage {name!r}; {registry.suggest(name)}")
    console.print(f"[bold]{name}[/] version {spec.version} from {escape(registry.origins[name])}", highlight=False)
    console.print(escape(spec.doc), highlight=False)
    for port in spec.all_ports:
        console.print(escape(f"  in   {port}"), highlight=False)
    console.print(escape(f"  out  {spec.output.kind_name()}"), highlight=False)
    table = Table("setting", "type", "default", "")
    properties = spec.params_type.model_json_schema()["properties"] if spec.params_type.model_fields else {}
    for field_name, field in spec.params_type.model_fields.items():
        schema = properties.get(field_name, {})
        default = "required" if field.default is PydanticUndefined else json.dumps(field.default, default=str)
        table.add_row(field_name, _type_name(schema), default, field.description or "")
    console.print(table)
    console.print(f"and for every stage: {', '.join(RESERVED_KEYS)}", highlight=False)


def _type_name(schema: dict[str, object]) -> str:
    if "enum" in schema:
        options = schema["enum"]
        return " | ".join(map(str, options)) if isinstance(options, list) else str(options)
    if "anyOf" in schema and isinstance(schema["anyOf"], list):
        return " | ".join(_type_name(option) for option in schema["anyOf"])
    return str(schema.get("const", schema.get("type", "")))
