"""The command line before workflows and folders that mean harm: a message, exit code 2, nothing written or imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Command

PLANTED = "import pathlib\npathlib.Path(__file__).with_suffix('.ran').touch()\n"
HEAD = "pano_mvs: 1\nstages:\n"


@pytest.mark.parametrize("command", ["check", "plan", "run", "status", "schema"])
def test_every_command_refuses_in_the_same_way(pano_mvs: Command, command: str) -> None:
    Path("bad.yaml").write_text(
        HEAD + "  images: {use: source.folder, path: !!python/object/apply:os.system [touch x]}\n"
    )
    result = pano_mvs(command, "bad.yaml")
    assert result.code == 2, result.text
    assert "bad.yaml:3:38: tag" in result.flat
    assert "Traceback" not in result.text
    assert [path.name for path in Path.cwd().iterdir()] == ["bad.yaml"], "no cache, no output, nothing else"


def test_no_plain_files(pano_mvs: Command) -> None:
    Path("folder").mkdir()
    Path("binary").write_bytes(b"\x89PNG\r\n\x1a\n\0\xff")
    os.mkfifo("pipe") if os.name == "posix" else Path("pipe").mkdir()
    for name in ("folder", "binary", "pipe", "/dev/zero", "x" * 5000, "nothing"):
        result = pano_mvs("run", name)
        assert result.code == 2, result.text
        assert "Traceback" not in result.text
        assert "workflow" in result.text
    assert sorted(path.name for path in Path.cwd().iterdir()) == ["binary", "folder", "pipe"]


def test_a_folder_of_ones_name_does_not_hide_a_preset(pano_mvs: Command) -> None:
    Path("quickstart").mkdir()
    assert pano_mvs("check", "quickstart").code == 0


def test_stages_may_not_write_where_the_run_does_or_outside(pano_mvs: Command) -> None:
    for to in ("../up", "/abs", "a/../../b", "logs", "'C:\\x'", "nul"):
        Path("bad.yaml").write_text(HEAD + f"  images: {{use: source.folder, path: ., to: {to}}}\n")
        result = pano_mvs("run", "bad.yaml")
        assert result.code == 2, result.text
        assert "bad.yaml:3:" in result.flat
        assert "stage 'images': to: " in result.flat


@pytest.mark.slow
def test_nothing_is_imported_from_the_current_folder_but_what_is_named(tmp_path: Path) -> None:
    """Modules that anything of ours might look for lie among somebody's pictures, and beside the workflow."""
    names = ("numpy", "numba", "json", "pickle", "random", "helper", "sitecustomize", "conftest", "jinja2")
    for name in (*names, "plug"):
        (tmp_path / f"{name}.py").write_text(PLANTED)
    (tmp_path / "wf.yaml").write_text("pano_mvs: 1\nplugins: [plug.py]\nextends: quickstart\n")
    result = subprocess.run(
        [sys.executable, "-m", "pano_mvs", "check", "wf.yaml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert "plug.py defines no stage" in " ".join(result.stderr.split())
    assert [path.name for path in tmp_path.glob("*.ran")] == ["plug.ran"]
