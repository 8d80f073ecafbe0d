"""What each plugin brings: stages, what it registers beside them, and what it offers by entry points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from typing import Any

from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.commands import COMMANDS
from pano_mvs.core.doors import FUNCTIONS, Door, installed, is_bundled, origin_of
from pano_mvs.core.text import plural
from pano_mvs.engine.executors.choose import EXECUTORS
from pano_mvs.engine.stages.registry import ENTRY_POINT_GROUP, Registry
from pano_mvs.io.readers import CAPTURE_READERS, POSE_READERS
from pano_mvs.session.observers import OBSERVERS

DOORS: tuple[Door[Any], ...] = (COMMANDS, EXECUTORS, OBSERVERS, CAPTURE_READERS, POSE_READERS, FUNCTIONS)
_LISTED = 3  # more stages than these are counted


@dataclass
class PluginRow:
    """A plugin, as `pano-mvs plugins` shows it."""

    source: str  # "built in", "bundled", "installed", "environment" or "file"
    brings: dict[str, list[str]] = field(default_factory=dict)  # kind to names
    broken: bool = False  # whether it, or something that it offers, cannot be loaded
    environment: str = ""  # the folder of its own environment, if it has one

    def add(self, kind: str, name: str) -> None:
        """Add a name, which may be there already."""
        names = self.brings.setdefault(kind, [])
        if name not in names:
            names.append(name)

    @property
    def text(self) -> str:
        """What it brings, in words, and where its environment is."""
        brings = "; ".join(
            f"{len(names)} stages"
            if kind == "stage" and len(names) > _LISTED
            else f"{plural(len(names), kind)} {', '.join(names)}"
            for kind, names in self.brings.items()
        )
        return f"{brings}; in {self.environment}" if self.environment else brings

    def to_json(self, origin: str) -> dict[str, Any]:
        """Return the row as a JSON value."""
        state = "broken" if self.broken else "ok"
        brings = {kind: list(names) for kind, names in self.brings.items()}
        return {
            "plugin": origin,
            "from": self.source,
            "environment": self.environment or None,
            "state": state,
            "brings": brings,
        }


def plugin_rows(registry: Registry, problems: Mapping[tuple[str, str], str]) -> dict[str, PluginRow]:
    """Return a row for each plugin, by its origin: a distribution, the package of a bundled plugin, or a file.

    Args:
        problems: why entry points cannot be used, see `entry_problems`.
    """
    rows: dict[str, PluginRow] = {}
    sources = {origin_of(entry): _source(entry) for _, _, entry in _entries()}
    for plugin in registry.plugins:
        source = "environment" if plugin.environment else sources.get(plugin.origin, "file")
        row = rows.setdefault(plugin.origin, PluginRow(source, environment=plugin.environment))
        row.broken |= bool(plugin.error)
        for kind, name in plugin.names:
            row.add(kind, name)
    for kind, name, entry in _entries():
        if kind:
            row = rows.setdefault(origin_of(entry), PluginRow(sources[origin_of(entry)]))
            row.broken |= (kind, name) in problems
            row.add(kind, name)
    return rows


def entry_problems(*, check: bool) -> dict[tuple[str, str], str]:
    """Return why entry points cannot be used, by kind and name.

    Args:
        check: whether to load all; otherwise only names that two packages offer are found.
    """
    return {
        (door.kind, name): problem
        for door in DOORS
        for name, entries in installed(door.group).items()
        if (check or len(entries) > 1) and (problem := door.problem(name))
    }


def broken_reasons(registry: Registry, problems: Mapping[tuple[str, str], str]) -> list[str]:
    """Return why plugins are broken, once for each, however many names it offers; see `entry_problems`."""
    reasons = {plugin.origin: plugin.why_broken() for plugin in registry.broken}
    others: dict[str, list[str]] = {}
    for kind, name, entry in _entries():
        if problem := problems.get((kind, name)):
            origin = origin_of(entry)
            if reasons.setdefault(origin, problem) != problem:
                others.setdefault(origin, []).append(f"{kind} {name}")
    return [
        f"{reason}\nlikewise: {', '.join(others[origin])}" if origin in others else reason
        for origin, reason in reasons.items()
    ]


def plugin_table(rows: Mapping[str, PluginRow]) -> Table:
    """Return a table with one row for each plugin."""
    table = Table("plugin", "from", "state", "brings")
    for origin, row in rows.items():
        state = "[red]broken[/]" if row.broken else "ok"
        table.add_row(escape(origin), row.source, state, escape(row.text))
    return table


def _entries() -> Iterator[tuple[str, str, EntryPoint]]:
    """Yield the kind, the name and the entry point of all that packages offer; "" for modules with stages."""
    for kind, group in (("", ENTRY_POINT_GROUP), *((door.kind, door.group) for door in DOORS)):
        for name, entries in sorted(installed(group).items()):
            for entry in entries:
                yield kind, name, entry


def _source(entry: EntryPoint) -> str:
    if is_bundled(entry):
        return "built in" if entry.module.partition(".")[0] == "pano_mvs" else "bundled"
    return "installed"
