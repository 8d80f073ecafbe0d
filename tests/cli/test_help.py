"""`--help`: what is used most comes first, the rest in groups with a heading."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import pytest
from typer.main import get_command

from pano_mvs.cli.app import app
from tests.cli.conftest import Command

MOST = 10


def leaves(command: Any, words: tuple[str, ...] = ()) -> list[Any]:
    """Return the commands that are not groups, each with the words that call it."""
    inner = getattr(command, "commands", None)
    if not inner:
        return [pytest.param(words, command, id=" ".join(words))]
    return [leaf for name, child in inner.items() for leaf in leaves(child, (*words, name))]


@pytest.mark.parametrize(("words", "command"), leaves(get_command(app)))
def test_no_group_is_longer_than_ten_options(words: tuple[str, ...], command: Any) -> None:
    """`run --help` showed 24 options in one list."""
    panels = Counter(option.rich_help_panel for option in command.params if option.param_type_name == "option")
    panels[None] += 1  # --help
    assert max(panels.values()) <= MOST, panels


def test_the_options_of_everyday_use_are_the_first(pano_mvs: Command) -> None:
    text = pano_mvs("run", "--help").text
    headings = re.findall(r"─ ([A-Z][\w ]+) ─", text)
    assert headings == ["Arguments", "Options", "Workers", "Disk and messages", "Selection of units",
                        "Blocks of a large capture"]  # fmt: skip
    first = re.search(r"─ Options ─(.*?)╰", text, re.DOTALL)
    assert first
    assert {"--images", "--out", "--set", "--cache", "--workers", "--until", "--dry-run"} <= set(
        re.findall(r"--[\w-]+", first[1])
    )
