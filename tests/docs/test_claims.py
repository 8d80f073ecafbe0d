"""Versions, extras and capabilities that the documentation states are those of the package."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.core import TyperOption
from typer.main import get_command

from pano_mvs.cli.app import app
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.policy import Policy

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OPENS_PANORAMAS = "4.1"
"""pycolmap 4.1.0 opens a model of EQUIRECTANGULAR cameras; 4.0.3 says that the camera model does not exist."""

VERSION = r"(\d+\.\d+)(?:\.\d+)?"
LIMITS = (rf"{VERSION}\s+or\s+newer", rf"older\s+than\s+{VERSION}", rf"since\s+version\s+{VERSION}")


def limits_of(program: str, text: str) -> list[str]:
    """Return the versions that sentences about a program give as the oldest that works."""
    sentences = re.split(r"(?<=[.;|])\s", text)
    behind = [sentence.partition(program)[2] for sentence in sentences if program in sentence]
    return [version for text in behind for limit in LIMITS for version in re.findall(limit, text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_oldest_versions_are_right(page: Path) -> None:
    """Six pages said that COLMAP 4.2 is needed to open a model that 4.1 opens."""
    text = page.read_text(encoding="utf-8")
    assert set(limits_of("COLMAP", text)) <= {OPENS_PANORAMAS}
    oldest_python = PROJECT["requires-python"].removeprefix(">=")
    assert set(re.findall(rf"Python\s+{LIMITS[0]}", text)) <= {oldest_python}


def test_the_versions_are_found() -> None:
    pages = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
    named = [name for name, text in pages.items() if limits_of("COLMAP", text)]
    assert len(named) >= 5
    assert limits_of("COLMAP", "COLMAP 4.2 or newer opens it.") == ["4.2"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_extras_exist(page: Path) -> None:
    named = re.findall(r"pano-mvs\[([\w,]+)\]", page.read_text(encoding="utf-8"))
    assert {extra for names in named for extra in names.split(",")} <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize(
    ("denied", "stage"),
    [
        (r"fisheye images are not supported", "source.dual_fisheye"),
        (r"photographs are not supported|[Pp]erspective .* not supported", "poses.localise"),
        (r"[Nn]o (neural )?networks? (is|are) included", "masks.operator"),
    ],
)
def test_what_a_stage_does_is_not_denied(denied: str, stage: str) -> None:
    """The faq denied what other pages described."""
    assert stage in Registry.installed().stages
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert not [hit for hit in re.findall(rf"(?<!Single )(?:{denied})", text) if hit], page


COMMANDS = {"share": "share", "viewer": "view", "running": "run", "large_captures": "run"}
"""Page to the command whose options its tables list."""

NUMBER = r"([\d][\d,]*)"


def options_of(page: str) -> dict[str, tuple[str, TyperOption]]:
    """Return the rows of a page that begin with an option, and the option of the command."""
    program: Any = get_command(app)
    command = program.commands[COMMANDS[page]]
    known = {name: option for option in command.params for name in option.opts}
    rows = re.findall(r"^\| `(--[\w-]+)[^|]*\|(.*)\|$", (ROOT / "docs" / f"{page}.md").read_text(), re.MULTILINE)
    return {name: (text, known[name]) for name, text in rows if name in known}


@pytest.mark.parametrize("page", COMMANDS)
def test_defaults_of_options_are_right(page: str) -> None:
    found = options_of(page)
    assert len(found) >= 3
    for name, (text, option) in found.items():
        alone = re.match(rf" {NUMBER} \|", text)
        stated = [alone[1]] if alone else re.findall(rf"[Dd]efault:? {NUMBER}", text)
        for number in stated:
            assert int(number.replace(",", "")) == option.default, name


@pytest.mark.parametrize("page", COMMANDS)
def test_zero_means_the_same_in_help_and_on_the_page(page: str) -> None:
    """`share --points 0` leaves out the cloud; its help said that all points are kept."""
    for name, (text, option) in options_of(page).items():
        here = re.findall(r"\b0 (?:draws|for|means) (\w+)", text)
        there = re.findall(r"\b0: (\w+)", option.help or "")
        assert not here or not there or here[0] in there or {here[0], there[0]} <= {"no", "none"}, name


def test_keys_of_every_stage_have_their_defaults() -> None:
    table = (ROOT / "docs" / "workflows.md").read_text(encoding="utf-8").partition("| key | default |")[2]
    rows = re.findall(r"^\| `(\w+)` \| ?`?([\w.]*)`? ?\|", table.partition("\n\n")[0], re.MULTILINE)
    fields = {info.alias or name: info.default for name, info in Policy.model_fields.items() if name != "use"}
    shown = {
        key: "" if default in ({}, "", None) else str(default).removesuffix(".0") for key, default in fields.items()
    }
    assert dict(rows) == shown


def test_parts_of_the_sweep_have_their_defaults() -> None:
    table = (ROOT / "docs" / "sweep_parts.md").read_text(encoding="utf-8").partition("| part | values | default |")[2]
    rows = re.findall(r"^\| `(\w+)`[^|]*\|[^|]*\| `(\w+)` \|", table.partition("\n\n")[0], re.MULTILINE)
    fields = Registry.installed().stages["depth.sweep"].params_type.model_fields
    assert len(rows) >= 6
    assert dict(rows) == {key: fields[key].default for key, _ in rows}


def test_every_export_is_on_its_page() -> None:
    text = (ROOT / "docs" / "exports.md").read_text(encoding="utf-8")
    exports = [name for name in Registry.installed().stages if name.startswith("export.")]
    assert [name for name in exports if f"`{name}`" not in text] == []
