"""The commands of the command line, those of plugins among them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from typer.main import get_command

from pano_mvs.cli.app import app


def all_commands() -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield each command, groups included, with the words that call it."""
    root = get_command(app)
    yield from _below(root, root.make_context("pano-mvs", [], resilient_parsing=True), ())


def _below(command: Any, context: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        child = command.get_command(context, name)
        inner = child.make_context(name, [], parent=context, resilient_parsing=True)
        yield from _below(child, inner, (*words, name))
