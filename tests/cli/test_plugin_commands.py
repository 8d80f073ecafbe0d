"""Commands of plugins run like built-in ones, and a bad one affects no other command."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command
from tests.plugin_packages import Packages

HELLO = '''\
from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.api import InputError
from pano_mvs.cli.commands import register_command
from pano_mvs.cli.console import Console


@register_command("{name}")
def hello(
    name: Annotated[str, typer.Argument(help="Whom to greet.")],
    place: Annotated[Path | None, typer.Option(help="Where.")] = None,
) -> None:
    """Say hello to somebody."""
    if name == "nobody":
        raise InputError("nobody is here: name somebody")
    Console().say(f"hello {{name}} at {{place}}")
'''
APP = '''\
import typer

app = typer.Typer(help="Count things.", no_args_is_help=True)


@app.command()
def up(to: int) -> None:
    """Count up."""
    if to < 0:
        raise FileNotFoundError(2, "No such file", "numbers.txt")
    print(*range(to))


@app.command()
def down(to: int) -> None:
    """Count down."""
    print(*range(to, 0, -1))
'''


def test_a_file_in_the_users_folder_brings_a_command(pano_mvs: Command, mine: Path) -> None:
    (mine / "hello.py").write_text(HELLO.format(name="hello"))
    result = pano_mvs("hello", "you", "--place", "home")
    assert (result.code, result.flat) == (0, "hello you at home")
    assert "Say hello to somebody." in pano_mvs("--help").flat
    assert "Whom to greet." in pano_mvs("hello", "-h").flat


def test_errors_of_a_command_are_messages_and_exit_codes(pano_mvs: Command, mine: Path) -> None:
    (mine / "hello.py").write_text(HELLO.format(name="hello"))
    result = pano_mvs("hello", "nobody")
    assert (result.code, result.flat) == (2, "error: nobody is here: name somebody")
    for wrong in (("hello", ""), ("hello", "you", "--place", "")):
        result = pano_mvs(*wrong)
        assert result.code == 2
        assert "the name is empty" in result.flat


def test_a_command_of_a_file_can_belong_to_a_group(pano_mvs: Command, mine: Path) -> None:
    (mine / "hello.py").write_text(HELLO.format(name="cache.hello"))
    assert pano_mvs("cache", "hello", "you").flat == "hello you at None"
    assert "Say hello to somebody." in pano_mvs("cache", "--help").flat
    assert "Say hello to somebody." not in pano_mvs("--help").flat
    for wrong in (("hello", "you"), ("cache.hello", "you")):
        result = pano_mvs(*wrong)
        assert result.code == 2
        assert "No such command" in result.flat


def test_a_package_brings_an_app_with_several_commands(pano_mvs: Command, packages: Packages) -> None:
    packages.add("counters", {"commands": {"count": "counters:app"}}, counters=APP)
    assert pano_mvs("count", "up", "3").flat == "0 1 2"
    assert pano_mvs("count", "down", "3").flat == "3 2 1"
    assert "Count things." in pano_mvs("--help").flat
    assert "Count down." in pano_mvs("count", "--help").flat
    result = pano_mvs("count", "up", "--", "-1")
    assert (result.code, result.flat[:39]) == (4, "error: numbers.txt: No such file. Correc"[:39])


def test_errors_of_a_function_of_a_package_are_messages_too(pano_mvs: Command, packages: Packages) -> None:
    fail = 'from pano_mvs.api import UsageError\n\n\ndef fail() -> None:\n    raise UsageError("use it otherwise")\n'
    packages.add("failures", {"commands": {"fail": "failures:fail"}}, failures=fail)
    result = pano_mvs("fail")
    assert (result.code, result.flat) == (2, "error: use it otherwise")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1 / 0\n", "ZeroDivisionError: division by zero"),
        ("command = 3\n", "is not a command"),
        ("def command(x: int | str): ...\n", "support Union types"),
        ("def command(x: 'Unknown'): ...\n", "name 'Unknown' is not defined"),
        ('raise ValueError("[/red] is no markup")\n', "[/red] is no markup"),
    ],
)
def test_a_broken_command_says_why_and_affects_no_other(
    pano_mvs: Command, packages: Packages, text: str, reason: str
) -> None:
    packages.add("dark", {"commands": {"shine": "dark:command", "cache.shine": "dark:command"}}, dark=text)
    packages.add("counters", {"commands": {"count": "counters:app"}}, counters=APP)
    for group in ((), ("cache",)):
        listed = pano_mvs(*group, "--help")
        assert listed.code == 0, listed.text
        assert "shine (cannot be used: the command" in listed.flat.replace("│ ", "")
        result = pano_mvs(*group, "shine", "--bright", "x")
        assert result.code == 2
        assert result.flat.startswith("error: the command ")
        assert reason in result.flat
    assert pano_mvs("count", "up", "2").flat == "0 1"
    assert pano_mvs("cache", "ls").flat.startswith("error: .pano-mvs is not a cache")


def test_a_description_that_is_no_markup_is_shown_as_it_is(pano_mvs: Command, packages: Packages) -> None:
    """The help of all commands ended with a traceback."""
    text = 'def dim() -> None:\n    """Dim [/the] light."""\n'
    packages.add("dim", {"commands": {"dim": "dimmer:dim"}}, dimmer=text)
    assert "Dim [/the] light." in pano_mvs("--help").flat
    assert "Dim [/the] light." in pano_mvs("dim", "--help").flat


def test_a_command_that_two_files_define_cannot_be_used(pano_mvs: Command, mine: Path) -> None:
    (mine / "a.py").write_text(HELLO.format(name="hello"))
    (mine / "b.py").write_text(HELLO.format(name="hello").replace("def hello", "def again"))
    (mine / "c.py").write_text(HELLO.format(name="greet"))
    result = pano_mvs("hello", "you")
    assert result.code == 2
    assert "'hello' is defined twice" in result.flat
    assert pano_mvs("--help").code == 0
    assert pano_mvs("greet", "you").flat == "hello you at None"


def test_a_command_that_may_be_in_a_broken_file_shows_its_error(pano_mvs: Command, mine: Path) -> None:
    (mine / "hello.py").write_text("LIMIT = 1 / 0\n" + HELLO.format(name="hello"))
    result = pano_mvs("hello", "you")
    assert result.code == 2
    assert "there is no command 'hello'; these plugins could not be loaded" in result.flat
    assert "ZeroDivisionError" in result.flat
    assert "hello" not in pano_mvs("--help").flat
    assert "ZeroDivisionError" not in pano_mvs("check", "quickstart").flat


def test_plugins_cannot_replace_a_command(pano_mvs: Command, mine: Path) -> None:
    (mine / "mine.py").write_text(HELLO.format(name="check"))
    assert "no mistakes" in pano_mvs("check", "quickstart").flat
    assert pano_mvs("--help").flat.count("Say hello") == 0


def test_other_commands_import_no_plugin(pano_mvs: Command, packages: Packages) -> None:
    packages.add("dark", {"commands": {"shine": "dark:command"}}, dark="print('imported')\n1 / 0\n")
    assert "imported" not in pano_mvs("check", "quickstart").text
    assert "imported" in pano_mvs("shine").text
