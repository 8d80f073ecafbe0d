"""Versions, options, settings, defaults and capabilities that the documentation states are those of the package."""

from __future__ import annotations

import ast
import importlib
import re
import textwrap
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.core import TyperOption

import pano_mvs
from pano_mvs.core.yaml_text import MAX_DEPTH, MAX_VALUES
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.merged_stages import MAX_STAGES
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.workflow_file import MAX_BYTES, MAX_FILES
from pano_mvs.results.records import PosesSummary
from pano_mvs.scene import Poses
from pano_mvs.session.session import open_session
from tests.cli.command_tree import all_commands

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


OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
FILES = ("bin", "csv", "e57", "jpg", "json", "jsonl", "laz", "npz", "pgw", "ply", "png", "sh", "yaml")
NUMBER = r"([\d][\d,]*)"
# Options of other programs that a page names on their own.
OTHERS = {
    "docs/exports.md": {"--gut", "--depth-unit-scale-factor", "--depth_loss", "--data"},
    "docs/installation.md": {"--user"},
}


def prose(page: Path) -> str:
    """Return the text of a page without its blocks of code, in one line."""
    return FENCED.sub("", page.read_text(encoding="utf-8")).replace("\n", " ")


COMMANDS: dict[str, dict[str, TyperOption]] = {
    " ".join(words): {name: option for option in command.params for name in (*option.opts, *option.secondary_opts)}
    for words, command in all_commands()
}
TABLES = {"running": "run", "large_captures": "run"}
"""Page to the command whose options its tables list."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_exist(page: Path) -> None:
    """On the command that the text names, or else on any."""
    every = {name for options in COMMANDS.values() for name in options} | {"--help"}
    place = page.relative_to(ROOT).as_posix()
    for span in re.findall(r"`([^`]+)`", prose(page)):
        named = OPTION.findall(span)
        words = span.removeprefix("pano-mvs ").split()
        called = next((two for two in (" ".join(words[:2]), words[0]) if two in COMMANDS), None) if words else None
        if not named or (called is None and not span.startswith(("-", "pano-mvs"))) or place == "docs/benchmarks.md":
            continue  # another program, such as pip
        known = every | OTHERS.get(place, set()) if called is None else COMMANDS[called].keys() | {"--help"}
        assert set(named) <= known, span


def stages_by_name() -> dict[str, set[str]]:
    """Return what the name of a stage in the shipped workflows stands for."""
    found: dict[str, set[str]] = {}
    for path in (ROOT / "workflows").glob("*.yaml"):
        for name, entry in open_session(path).workflow.stages.items():
            found.setdefault(name, set()).add(entry.spec.name)
    return found


STAGES = Registry.installed().stages
NAMES = stages_by_name()


def defaults(stage: str, setting: str) -> list[Any]:
    """Return the defaults of a setting in the stages that a name stands for, or in all stages if it is empty."""
    specs = [STAGES[use] for use in NAMES.get(stage, ())] if stage else STAGES.values()
    return [
        spec.params_type.model_fields[setting].default for spec in specs if setting in spec.params_type.model_fields
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_stages_and_settings_exist(page: Path) -> None:
    """A remedy named `pairs.neighbours`, which the stage `pairs` of no preset has."""
    kinds = {name.partition(".")[0] for name in STAGES}
    ours = set(re.findall(r'@stage\(\s*"([\w.]+)"', "".join(path.read_text() for path in ROOT.glob("plugins/**/*.py"))))
    for name, key in re.findall(r"`([a-z]\w*)\.([a-z]\w*)`", prose(page)):
        if (name not in NAMES and name not in kinds) or key in FILES or page.name == "benchmarks.md":
            continue
        in_run_json = hasattr(PosesSummary, key) or key in PosesSummary.__annotations__ or hasattr(Poses, key)
        known = f"{name}.{key}" in {*STAGES, *ours} or defaults(name, key) or (name == "poses" and in_run_json)
        assert known, f"{name}.{key}"


STATED = re.compile(
    r"`(?:([a-z]\w*)\.)?([a-z]\w*)`(?: \((?:default:? )?|, (?=[\d.,]+ by default))(-?\d[\d.,]*\d|-?\d)(?![–\d])"
)
"""A setting with a number that is its default: `min_s` (0.2), `max_megapixels`, 512 by default."""


def test_defaults_of_settings_are_right() -> None:
    found = 0
    for page in PAGES:
        for stage, setting, number in STATED.findall(prose(page)):
            known = defaults(stage, setting)
            if known and all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in known):
                assert float(number.replace(",", "")) in known, f"{page.name}: {stage}.{setting} {number}"
                found += 1
    assert found >= 8


def test_limits_of_workflows_are_those_of_the_code() -> None:
    text = (ROOT / "docs" / "workflows.md").read_text(encoding="utf-8").replace("\n", " ")
    stated = re.search(
        rf"{NUMBER} values, {NUMBER} levels of nesting, {NUMBER} stages, {NUMBER} kB and {NUMBER} files", text
    )
    assert stated
    numbers = [int(number.replace(",", "")) for number in stated.groups()]
    assert numbers == [MAX_VALUES, MAX_DEPTH, MAX_STAGES, MAX_BYTES // 1000, MAX_FILES]


def test_versions_of_what_the_package_holds_are_right() -> None:
    wheels = {version for page in PAGES for version in re.findall(r"pano_mvs-([\d.]+)-py3", page.read_text())}
    assert wheels == {pano_mvs.__version__}
    (three,) = set(re.findall(r"three(?:@|\.js\]\(\S+\) )(0\.\d+)", (ROOT / "docs" / "share.md").read_text()))
    library = (ROOT / "plugins" / "page" / "pano_mvs_page" / "web" / "three.min.js").read_text(encoding="utf-8")
    assert f'"{three.removeprefix("0.")}"' in library


def test_every_stage_and_preset_is_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    readme = dict(re.findall(r"^\| \[?(\w+)[^|]*\| (.*) \|$", PAGES[0].read_text(encoding="utf-8"), re.MULTILINE))
    short = {f"{kind}.{name}" for kind, row in readme.items() for name in re.findall(r"`(\w+)`", row)}
    short |= {name.replace("exports.", "export.") for name in short}
    assert [name for name in STAGES if name not in text and name not in short] == []
    presets = re.findall(r"`(\w+)`", "".join(re.findall(r"^\| ((?:`\w+`,? ?)+)\|", PAGES[0].read_text(), re.MULTILINE)))
    assert {path.stem for path in (ROOT / "workflows").glob("*.yaml")} <= set(presets)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_python_imports_exists(page: Path) -> None:
    for _, language, code in FENCED.findall(page.read_text(encoding="utf-8")):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(textwrap.dedent(code))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pano_mvs") and not node.level:
                module = importlib.import_module(node.module or "")
                assert [one.name for one in node.names if not hasattr(module, one.name)] == []
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pano_mvs":
                assert hasattr(pano_mvs, node.attr), node.attr


def options_of(page: str) -> dict[str, tuple[str, TyperOption]]:
    """Return the rows of a page that begin with an option, and the option of the command."""
    known = COMMANDS[TABLES[page]]
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(--[\w-]+)[^|]*\|(.*)\|$", text, re.MULTILINE)
    return {name: (text, known[name]) for name, text in rows if name in known}


@pytest.mark.parametrize("page", TABLES)
def test_defaults_of_options_are_right(page: str) -> None:
    found = options_of(page)
    assert len(found) >= 3
    for name, (text, option) in found.items():
        alone = re.match(rf" {NUMBER} \|", text)
        stated = [alone[1]] if alone else re.findall(rf"[Dd]efault:? {NUMBER}", text)
        for number in stated:
            assert int(number.replace(",", "")) == option.default, name


@pytest.mark.parametrize("page", TABLES)
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
