"""Commands of the documentation that read the results of a run: they work, and an earlier command makes the results."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from tests.cli.conftest import SIZE_HW
from tests.docs.test_examples import ROOT, SCRIPTS, commands

VERBS = ("view", "share", "inspect", "report", "evaluate")
SUBJECTS = ("run", "poses", "depth", "cloud")
PLACEHOLDERS = {"OUT", "MODEL"}
# A page that continues another one, and the results that it expects from there.
EXPECTED = {
    "docs/share.md": {"lobby"},
    "docs/viewer.md": {"out/quickstart"},
    "docs/tutorials/sweep.md": {"quickstart"},
}


def reads_results(arguments: list[str]) -> bool:
    return arguments[0] in VERBS and "--help" not in arguments


def subject_place(arguments: list[str]) -> int:
    """Return the position of the output folder in a command that reads one."""
    return 2 if arguments[0] == "evaluate" and arguments[1] in SUBJECTS else 1


def made_by(arguments: list[str]) -> str:
    """Return the output folder of a `run`."""
    if "--out" in arguments:
        return arguments[arguments.index("--out") + 1]
    return f"out/{Path(arguments[1]).stem}"


@pytest.mark.parametrize("page", sorted({page for page, _ in SCRIPTS}), ids=lambda page: page.name)
def test_results_are_made_before_they_are_read(page: Path) -> None:
    known = set(EXPECTED.get(page.relative_to(ROOT).as_posix(), set())) | PLACEHOLDERS
    for script in [script for of_page, script in SCRIPTS if of_page == page]:
        for arguments in commands(script):
            if arguments[0] == "run":
                known.add(made_by(arguments))
            elif reads_results(arguments):
                read = arguments[subject_place(arguments)]
                assert any(read == one or read.startswith(f"{one}/") for one in known), shlex.join(arguments)


def adapted(arguments: list[str], finished: Path, truth: Path) -> list[str]:
    """Return a command for the finished run: its folders, its images and pixels in them, and no window."""
    words = list(arguments)
    place = subject_place(words)
    name = words[place]
    words[place] = str(finished / "out")
    if words[0] == "evaluate" and words[1:2] == ["poses"]:
        words[place] += "/colmap/sparse/0"
    values = {"--truth": truth, "--cache": finished / "cache"}
    for option, value in values.items():
        if option in words:
            words[words.index(option) + 1] = str(value)
    if words[0] == "view":
        words += ["--screenshot", "view.png"]
    if words[0] == "inspect":
        words[2:5] = ["000.png", str(int(words[3]) % SIZE_HW[1]), str(int(words[4]) % SIZE_HW[0])]
        if name == "quickstart":  # the preset, not an output folder
            words[place] = str(finished / "out")
    return words


def different_lines() -> list[str]:
    """Return the commands of all pages that read results; of those that are the same for the finished run, one."""
    found = (each for _, script in SCRIPTS for each in commands(script) if reads_results(each))
    by_what_runs = {shlex.join(adapted(each, Path("OUT"), Path("TRUTH"))): shlex.join(each) for each in found}
    return sorted(by_what_runs.values())


@pytest.mark.slow
@pytest.mark.parametrize("line", different_lines())
def test_commands_that_read_results_work(
    line: str, quickstart: tuple[Path, str], rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    finished = quickstart[0].parent
    arguments = adapted(shlex.split(line), finished, rendered / "truth")
    if arguments[0] == "report":  # it writes into the output folder
        shutil.copytree(finished / "out", tmp_path / "out")
        arguments[1] = str(tmp_path / "out")
        arguments += [] if "--cache" in arguments else ["--cache", str(finished / "cache")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, f"{line}:\n{result.output}"
