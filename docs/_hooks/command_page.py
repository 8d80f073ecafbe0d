"""Generate the reference of the command line from the commands."""

from __future__ import annotations

from typing import Any

import typer
from markdown_text import cell, escaped, table

from pano_mvs.cli.app import app

_INTRODUCTION = """# Commands

This page is generated from the commands; `pano-mvs COMMAND --help` prints the same text.
[Workflows](../workflows.md#exit-codes) lists the exit codes, and [Running](../running.md) describes what a run does."""


def command_page() -> str:
    """Return the page of all commands."""
    root = typer.main.get_command(app)
    listed = commands(root, "pano-mvs")
    rows = [(f"[`{path}`](#{_anchor(path)})", escaped(_first_line(command))) for path, command in listed]
    return "\n\n".join([_INTRODUCTION, table(("command", ""), rows), *(_section(*entry) for entry in listed)]) + "\n"


def commands(command: Any, path: str) -> list[tuple[str, Any]]:
    """Return all commands below one that are not groups, each with the words that call it."""
    inner = getattr(command, "commands", None)
    if not inner:
        return [(path, command)]
    return [found for name, child in inner.items() if not child.hidden for found in commands(child, f"{path} {name}")]


def _section(path: str, command: Any) -> str:
    context = command.context_class(command, info_name=path)
    records = [(parameter, parameter.get_help_record(context)) for parameter in command.params]
    rows = [
        (f"`{record[0]}`".replace("|", "\\|"), cell(record[1]))
        for parameter, record in records
        if record and not getattr(parameter, "hidden", False)
    ]
    usage = " ".join([path, *(piece.strip("{}") for piece in command.collect_usage_pieces(context))])
    parts = [f"## {path} {{ #{_anchor(path)} }}", escaped(command.help or ""), f"```\n{usage}\n```"]
    return "\n\n".join([*parts, table(("argument or option", ""), rows)] if rows else parts)


def _anchor(path: str) -> str:
    return path.removeprefix("pano-mvs ").replace(" ", "-")


def _first_line(command: Any) -> str:
    return str(command.help or "").partition("\n")[0]
