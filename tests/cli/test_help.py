"""Help and completion."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from tests.cli.command_tree import all_commands
from tests.cli.conftest import Command

MOST = 10


@pytest.mark.parametrize(
    ("words", "command"), [pytest.param(*found, id=" ".join(found[0])) for found in all_commands()]
)
def test_no_panel_is_longer_than_ten_options(words: tuple[str, ...], command: Any) -> None:
    """`run --help` showed 24 options in one list."""
    panels = Counter(option.rich_help_panel for option in command.params if option.param_type_name == "option")
    panels[None] += 1  # --help
    assert max(panels.values()) <= MOST, panels


def test_the_options_of_everyday_use_are_the_first(pano_mvs: Command) -> None:
    text = pano_mvs("run", "--help").text
    headings = re.findall(r"─ ([A-Z][\w ]+) ─", text)
    own = ["Arguments", "Options", "Workers", "Selection of units", "Disk and messages", "Blocks of a large capture"]
    assert [heading for heading in headings if heading != "Plugins"] == own
    first = re.search(r"─ Options ─(.*?)╰", text, re.DOTALL)
    assert first
    assert {"--images", "--out", "--set", "--cache", "--workers", "--until", "--dry-run"} <= set(
        re.findall(r"--[\w-]+", first[1])
    )


def offered(*words: str, shell: str = "bash") -> list[str]:
    """Return what bash is offered behind some words, the last one perhaps unfinished."""
    line = shlex.join(["pano-mvs", *words]) if words[-1] else shlex.join(["pano-mvs", *words[:-1]]) + " "
    environment = {
        "_PANO_MVS_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words)),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        "_TYPER_COMPLETE_WORD_TO_COMPLETE": words[-1],
    }
    result = CliRunner().invoke(app, [], env=environment, prog_name="pano-mvs")
    assert result.exit_code == 0, result.output
    return [text for text in result.output.splitlines() if text]


def test_commands_and_options_are_offered() -> None:
    assert "run" in offered("ru")
    assert "doctor" in offered("")
    assert "--images" in offered("run", "quickstart", "--i")


def test_presets_and_workflow_files_are_offered(pano_mvs: Command) -> None:
    Path("quick tests").mkdir()
    Path("quick tests/mine.yaml").write_text("pano_mvs: 1\n")
    Path("quiet.yml").write_text("pano_mvs: 1\n")
    Path("quoted.txt").write_text("x")
    assert offered("run", "qui") == ["quickstart", "quick tests/", "quiet.yml"]
    assert offered("plan", "quick tests/m") == ["quick tests/mine.yaml"]
    assert offered("run", "/nowhere/at/all") == []


def test_settings_of_the_workflow_and_their_values_are_offered() -> None:
    for command in ("run", "status", "show", "inspect"):
        assert offered(command, "quickstart", "--set", "depth.pl") == ["depth.planes="]
    found = offered("run", "quickstart", "--set", "images.")
    assert {"images.path=", "images.nadir_deg=", "images.masks="} <= set(found)
    assert all(text.startswith("images.") for text in found)
    assert offered("run", "known_poses", "--set", "poses.p") == ["poses.path="]
    backends = offered("run", "quickstart", "--set", "depth.backend=")
    assert {"depth.backend=numba", "depth.backend=opencv", "depth.backend=numpy"} <= set(backends)


def test_stages_of_the_workflow_and_registered_ones_are_offered() -> None:
    assert offered("run", "quickstart", "--until", "p") == ["pairs", "poses", "planes", "ply", "previews"]
    assert offered("plan", "quickstart", "--refresh", "de") == ["depth"]
    assert "depth.sweep" in offered("stage", "show", "depth.")
    assert offered("plugin", "new", "sweep") == ["sweep_cost", "sweep_backend"]


@pytest.mark.parametrize("text", ["pano_mvs: 1\nstages: {a: {use: nothing.such}}\n", "a: [", ""])
def test_a_shell_stays_silent_whatever_is_wrong(pano_mvs: Command, text: str) -> None:
    Path("bad.yaml").write_text(text)
    assert offered("run", "bad.yaml", "--set", "a") == []
    assert offered("run", "bad.yaml", "--until", "a") == []
    assert offered("run", "--set", "a") == []


@pytest.mark.parametrize("shell", ["zsh", "fish", "powershell"])
def test_other_shells_get_the_help_too(shell: str) -> None:
    (text,) = offered("run", "quickstart", "--set", "depth.planes", shell=shell)
    assert "depth.planes=" in text
    assert "hypotheses" in text


def test_the_script_for_a_shell_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shellingham.detect_shell", lambda *_: ("bash", "/bin/bash"))  # whoever runs the tests
    result = CliRunner().invoke(app, ["--show-completion", "bash"], prog_name="pano-mvs")
    assert result.exit_code == 0
    assert "complete_bash" in result.output
    assert "_PANO_MVS_COMPLETE" in result.output
