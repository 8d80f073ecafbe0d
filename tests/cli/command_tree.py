"""The commands of the command line, those of plugins among them.

`python -m tests.cli.command_tree` starts the help of each; with `pano_mvs_tours` behind it, in an installation from
which that package was deleted.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

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


def main(missing: str = "") -> None:
    """Start the help of each command, and fail if one cannot be used, except those of a package that is missing."""
    for words, _ in all_commands():
        result = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "1000"})
        assert result.exit_code == 0, result.output
        unusable = [line for line in result.output.splitlines() if "cannot be used" in line]
        assert all(missing and missing in line for line in unusable), "\n".join(unusable)


if __name__ == "__main__":
    main(*sys.argv[1:])
