"""Paths that commands of plugins cannot use."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command
from tests.permissions import permissions_hold

EVALUATIONS = ["evaluate cloud PATH --truth PATH", "evaluate poses PATH --truth PATH", "evaluate depth . --truth PATH"]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["locked/in", "locked/in/a.yaml", "n" * 300, "circle/x", "a\0b"])
def test_path_that_cannot_be_looked_at_is_no_bug_of_a_plugin(pano_mvs: Command, path: str) -> None:
    """`is_file` and its like raised below folders that may not be searched, and for names that are too long."""
    Path("locked/in").mkdir(parents=True)
    Path("locked/in/a.yaml").write_text("pano_mvs: 1\n")
    Path("circle").symlink_to("circle")
    Path("locked").chmod(0)
    with permissions_hold():
        results = {command: pano_mvs(*command.replace("PATH", path).split(" ")) for command in EVALUATIONS}
    Path("locked").chmod(0o700)
    for command, result in results.items():
        assert result.code == 2, (command, result.text)
        assert "error" in result.text.lower(), command
        assert "Traceback" not in result.text, command


@pytest.mark.parametrize(
    "command",
    [
        *(command.replace("PATH", "{}") for command in EVALUATIONS),
        "view {}",
        "view o --screenshot {}",
        "share {} --to p",
        "share o --to {}",
        "share o --to p --rooms {}",
        "calibrate {} --out c.yaml",
        "calibrate photos --out {}",
        "cache push {}",
    ],
)
def test_an_empty_path_is_refused_by_plugins(pano_mvs: Command, command: str) -> None:
    """A variable of the shell without a value stood for the current folder, which `share` then filled."""
    result = pano_mvs(*(word.format("") for word in command.split()))
    assert result.code == 2
    assert "the name is empty" in result.flat
    assert not any(Path().iterdir())
