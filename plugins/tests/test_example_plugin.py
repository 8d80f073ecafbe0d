"""The example distribution as it stands: its own tests pass, and its README's workflow is sound, installed or not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app

FOLDER = Path(__file__).parents[1] / "pano_mvs_example"


def run(*arguments: str, cwd: Path) -> str:
    environment = dict(os.environ) | {"PYTHONPATH": str(FOLDER), "PANO_MVS_PLUGINS": ""}
    result = subprocess.run([sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.slow
def test_its_own_tests_pass(tmp_path: Path) -> None:
    # In the folder that all test runs share, pytest warns of a scan that another one disturbs.
    run("-m", "pytest", "-q", "-p", "no:cacheprovider", "--basetemp", str(tmp_path / "own"), cwd=FOLDER)


@pytest.mark.slow
def test_it_is_typed() -> None:
    """What was found of pano_mvs when the checkout was checked is used again, if it was."""
    config, cache = (f"../../{name}" for name in ("pyproject.toml", ".mypy_cache"))
    run("-m", "mypy", "--strict", f"--config-file={config}", f"--cache-dir={cache}", "pano_mvs_example", cwd=FOLDER)


def test_its_workflow_is_sound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The workflow names the package's file, which is what a user does who has not installed it."""
    text = re.search(r"<!-- workflow -->\n```yaml\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
    assert text
    package = FOLDER / "pano_mvs_example"
    plugins = f"plugins: [{package / 'sky_mask.py'}, {package / 'xyz_file.py'}]\n"
    (tmp_path / "photos").mkdir()
    (tmp_path / "wf.yaml").write_text(text.group(1).replace("stages:\n", f"{plugins}stages:\n"))
    monkeypatch.chdir(tmp_path)
    assert "no mistakes" in CliRunner().invoke(app, ["check", "wf.yaml"]).output
