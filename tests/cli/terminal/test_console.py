"""What the commands print of names, notes and exceptions."""

from __future__ import annotations

import io

from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console

HOSTILE = "000\x1b[2J\x1b]0;owned\x07\x9b31m.jpg"


def printed(*things: object, terminal: bool = True) -> str:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, color_system="standard", width=80)
    for thing in things:
        console.print(thing, highlight=False, soft_wrap=True)
    return stream.getvalue()


def test_control_characters_are_shown_and_colours_are_ours() -> None:
    text = printed(f"[red]failed:[/] {escape(HOSTILE)}")
    assert text.startswith("\x1b[31mfailed:\x1b[0m 000\\x1b[2J\\x1b]0;owned")
    assert text.count("\x1b") == 2
    assert "\x9b" not in text


def test_tables_are_safe_too() -> None:
    table = Table("image")
    table.add_row(escape(HOSTILE))
    assert "\x1b[2J" not in printed(table)
    assert "000\\x1b[2J" in printed(table)


def test_a_megabyte_is_not_printed() -> None:
    assert len(printed("x" * 1_000_000, terminal=False)) < 11_000
