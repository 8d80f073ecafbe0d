"""What the documentation tells people to type exists: commands and their options, workflows and their settings."""

from __future__ import annotations

import re
import shlex
import shutil
import textwrap
from collections import defaultdict
from contextlib import suppress
from functools import cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.workflows.policy import RESERVED_KEYS
from pano_mvs.session.session import open_session
from tests.algorithms.learned.grey_network import GREY_NETWORK
from tests.synthetic.tour_files import write_tour
from tests.synthetic.video_files import tiny_video

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("docs/**/*.md"), ROOT / "README.md"])
FENCED = re.compile(r"^( *)```(\w+)\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
NO_WORKFLOW = tuple(
    f"<!-- {mark} -->\n" for mark in ("variants", "calibration", "queue", "rooms", "combinations", "group")
)
# What the workflows of the pages read; empty files will do where nothing is run.
FOLDERS = (
    "phone",
    "photos/lobby",
    "photos/flat",
    "photos/house",
    "photos/site",
    "masks",
    "out/site/colmap/sparse/0",
    "colmap/sparse/0",
    "lobby/colmap/sparse/0",
    "truth",
    "videos",
)
FILES = ("walk.mp4", "mask.png", "rig.yaml", "phone/1.jpg")
# What the commands of the pages read, where they are run.
PICTURES = {
    "photos/lobby": ("hall.jpg", "stairs.jpg"),
    "photos/flat": ("1.jpg", "2.jpg"),
    "photos/house": ("001.jpg", "002.jpg"),
    "photos/site/hall": ("0412.jpg", "0413.jpg"),
}


def blocks(language: str) -> list[Any]:
    """Return the fenced blocks of all pages, each with the place where it stands."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in FENCED.finditer(text):
            if match[2] == language and not text[: match.start()].endswith(NO_WORKFLOW):
                place = f"{page.relative_to(ROOT)}:{text[: match.start()].count(chr(10)) + 1}"
                found.append(pytest.param(page, textwrap.dedent(match[3]), id=place))
    return found


def commands(script: str) -> list[list[str]]:
    """Return the words after `pano-mvs` of each command in a script."""
    lines = re.sub(r"\\\n", " ", script).splitlines()
    parts = [part for line in lines for part in re.split(r"&&|\||;", re.sub(r"(^|\s)#.*", "", line))]
    words = [shlex.split(part) for part in parts]
    return [found[1:] for found in words if found and Path(found[0]).name == "pano-mvs"]


@cache
def _program() -> Any:
    return typer.main.get_command(app)


def parse(arguments: list[str]) -> None:
    """Parse a command line as the program does, down to the command that it calls, without calling it."""
    command = _program()
    if arguments[0] in ("--install-completion", "--show-completion"):  # would do so, here and now
        assert any(arguments[0] in parameter.opts for parameter in command.params)
        return
    context = command.make_context("pano-mvs", list(arguments))
    while getattr(command, "commands", None):
        name, command, arguments = command.resolve_command(context, [*context._protected_args, *context.args])
        context = command.make_context(name, arguments, parent=context)


def inline_commands() -> list[Any]:
    """Return what stands in running text as code and begins with the program's name, with the page."""
    found = []
    for page in PAGES:
        prose = FENCED.sub("", page.read_text(encoding="utf-8")).replace("\n", " ")
        spans = sorted(set(re.findall(r"`(pano-mvs [a-z][^`]*)`", prose)))
        found += [pytest.param(page, span, id=f"{page.relative_to(ROOT)}: {span}") for span in spans]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_number_is_taken_for_a_heading(page: Path) -> None:
    """The number of an issue that began a line, #1494, was shown as a heading."""
    assert not re.search(r"^#+[^#\s]", FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)


@pytest.mark.parametrize(("page", "script"), blocks("bash"))
def test_every_command_can_be_parsed(page: Path, script: str) -> None:
    for arguments in commands(script):
        with suppress(typer.Exit):  # `--help`
            parse(arguments)


@pytest.mark.parametrize(("page", "mention"), inline_commands())
def test_every_command_in_running_text_exists(page: Path, mention: str) -> None:
    for arguments in commands(mention):
        try:
            parse(arguments)
        except Exception as error:
            if "Missing" not in type(error).__name__:  # named without its arguments
                raise


@pytest.mark.parametrize("wrong", ["run quickstart --imags photos", "run", "evaluate nothing", "rnu quickstart"])
def test_a_command_that_there_is_not_is_noticed(wrong: str) -> None:
    with pytest.raises(Exception, match=r"[Nn]o such|[Mm]issing"):
        parse(wrong.split())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with what the pages' workflows read."""
    for name in FOLDERS:
        (tmp_path / name).mkdir(parents=True)
    for name in FILES:
        (tmp_path / name).touch()
    write_tour(tmp_path / "tour", "Marzipano")
    shutil.copy(GREY_NETWORK, tmp_path / "network.onnx")
    for path in ROOT.glob("plugins/examples/*.py"):
        shutil.copy(path, tmp_path)
    for name in ("my.yaml", "workflow.yaml"):
        (tmp_path / name).write_text("pano_mvs: 1\nextends: quickstart\n")
    for page in PAGES:
        for name, text in re.findall(r"Save this\s+as `([^`/]+)`.*?```\w+\n(.*?)```", page.read_text(), re.DOTALL):
            (tmp_path / name).write_text(text)
    return tmp_path


def as_workflow(text: str) -> str:
    """Return a block as a workflow: a piece of one is laid over quickstart."""
    if re.search(r"^(pano_mvs|extends):", text, re.MULTILINE):
        return text
    if text.startswith("stages:"):
        return f"pano_mvs: 1\nextends: quickstart\n{text}"
    return f"pano_mvs: 1\nextends: quickstart\nstages:\n{textwrap.indent(textwrap.dedent(text), '  ')}"


@pytest.mark.parametrize(("page", "text"), blocks("yaml"))
def test_every_workflow_is_sound(folder: Path, page: Path, text: str) -> None:
    (folder / "mine.yaml").write_text(as_workflow(text))
    result = CliRunner().invoke(app, ["check", str(folder / "mine.yaml")])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(("page", "script"), blocks("bash"))
def test_every_setting_of_a_command_exists(
    folder: Path, monkeypatch: pytest.MonkeyPatch, page: Path, script: str
) -> None:
    monkeypatch.chdir(folder)
    for verb, *arguments in commands(script):
        if verb in ("run", "plan", "check") and not arguments[0].startswith("workflows/"):
            changes = [pair for pair in pairwise(arguments) if pair[0] in ("--set", "--images")]
            result = CliRunner().invoke(app, ["check", arguments[0], *chain(*changes)])
            assert result.exit_code == 0, result.output


def runnable(arguments: list[str], cache: Path) -> list[str]:
    """Return a command as the test runs it; nothing if it needs more than a few panoramas and some seconds.

    A run, and each run of `vary`, ends with its stage `images`. What reads the results of a whole run, opens a window,
    or needs a scheduler, a queue or pictures of two lenses is left out.
    """
    if arguments[0] not in ("run", "vary", "check", "plan", "status", "stage", "plugins", "schema", "cache"):
        return []
    if {"--scheduler", "--queue", "--only", "--explain", "pin", "images.use=source.dual_fisheye"} & set(arguments):
        return []
    words = [str(cache) if word == "/shared/cache" else word for word in arguments]
    if words[0] in ("run", "vary"):
        words += [] if "--until" in words else ["--until", "images"]
        words[words.index("--until") + 1] = "images"
    return words


SCRIPTS = [block.values[:2] for block in blocks("bash")]


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({page for page, _ in SCRIPTS}), ids=lambda page: page.name)
def test_the_commands_of_a_page_run_one_after_the_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch, page: Path
) -> None:
    for place, names in PICTURES.items():
        (folder / place).mkdir(parents=True, exist_ok=True)
        for number, name in enumerate(names):
            picture = np.random.default_rng(number).integers(0, 256, (64, 128, 3), np.uint8)
            assert cv2.imwrite(str(folder / place / name), picture)
            assert cv2.imwrite(str(folder / "masks" / f"{name}.png"), np.full((64, 128), 255, np.uint8))
    shutil.copy(tiny_video(), folder / "videos" / "walk.mp4")
    shutil.copytree(ROOT / "workflows", folder / "workflows")
    monkeypatch.chdir(folder)
    for script in [script for of_page, script in SCRIPTS if of_page == page]:
        for arguments in filter(None, (runnable(command, folder / "cache") for command in commands(script))):
            result = CliRunner().invoke(app, arguments)
            assert result.exit_code == 0, f"{shlex.join(arguments)}:\n{result.output}"


def test_a_command_of_a_page_is_cut_short_or_left_out(tmp_path: Path) -> None:
    assert runnable(["run", "fast", "--until", "depth"], tmp_path) == ["run", "fast", "--until", "images"]
    assert runnable(["run", "fast"], tmp_path) == ["run", "fast", "--until", "images"]
    assert runnable(["plan", "fast", "--cache", "/shared/cache"], tmp_path)[-1] == str(tmp_path)
    assert runnable(["run", "fast", "--scheduler", "tcp://host:8786"], tmp_path) == []
    assert runnable(["run", "fast", "--executor", "slurm", "--queue", "slurm.yaml"], tmp_path) == []
    assert runnable(["vary", "fast", "--set", "depth.planes=1,2"], tmp_path)[-2:] == ["--until", "images"]
    assert runnable(["view", "out/fast"], tmp_path) == []


def settings_in_text() -> list[Any]:
    """Return each `stage.setting=value` that stands in running text, with the page."""
    found = []
    for page in PAGES:
        prose = FENCED.sub("", page.read_text(encoding="utf-8"))
        spans = sorted(set(re.findall(r"`(?:--set )?([a-z]\w*)\.([a-z]\w*)=([^`\s]+)`", prose)))
        found += [pytest.param(*span, id=f"{page.relative_to(ROOT)}: {'.'.join(span[:2])}={span[2]}") for span in spans]
    return found


@pytest.fixture(scope="module")
def specs_by_stage() -> dict[str, list[StageSpec]]:
    """What each name of a stage in the shipped workflows stands for."""
    specs: dict[str, list[StageSpec]] = defaultdict(list)
    for path in (ROOT / "workflows").glob("*.yaml"):
        for name, entry in open_session(path).workflow.stages.items():
            specs[name].append(entry.spec)
    return specs


@pytest.mark.parametrize(("stage", "setting", "value"), settings_in_text())
def test_every_setting_in_running_text_exists(
    specs_by_stage: dict[str, list[StageSpec]], stage: str, setting: str, value: str
) -> None:
    if setting in RESERVED_KEYS or setting == "group":
        return
    known = [spec for spec in specs_by_stage[stage] if setting in spec.params_type.model_fields]
    assert known
    if not value.isupper():  # DIR and FILE stand for any
        for spec in known:
            spec.params_type.__pydantic_validator__.validate_assignment(
                spec.params_type.model_construct(), setting, YAML(typ="safe").load(value)
            )
