"""`python -m tools` lists the scripts and runs them with their options."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tools.__main__ import HERE, main, scripts


def test_the_list_has_a_line_for_each_script_of_a_group(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    every = capsys.readouterr().out
    main(["stress"])
    listed = capsys.readouterr().out
    for name, summary in scripts().items():
        assert summary.endswith(".")
        assert f"{name} " in every
        assert (f"{name} " in listed) == name.startswith("stress ")
    assert {"mutation", "export_networks", "benchmarks poses.tours.houses"} <= scripts().keys()


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["stress", "kills"], "--executor"),
        (["mutation"], "[GROUP ...]"),
        (["export_networks"], "OUTPUT_FOLDER"),
        (["benchmarks", "poses.features"], "--runs"),
    ],
)
def test_help_shows_the_options(
    words: list[str], option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [])  # a script that reads the command line itself gets its own
    with pytest.raises(SystemExit, match="0"):
        main([*words, "--help"])
    assert option in capsys.readouterr().out


def test_a_main_without_parameters_parses_the_command_line() -> None:
    mains = {
        path: node
        for path in HERE.rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef) and node.name == "main"
    }
    assert len(mains) == len(scripts()) + 1  # and the runner's own
    for path, node in mains.items():
        names = {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}
        assert ast.unparse(node.args) or "parse_args" in names, path


@pytest.mark.parametrize("group", ["stress", "benchmarks", "benchmarks poses", "benchmarks poses.tours"])
def test_groups_list_their_scripts(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([*group.split(), "--help"])
    listed = capsys.readouterr().out
    for name in scripts():
        assert (f"\n{name} " in listed) == name.startswith((f"{group} ", f"{group}."))


def test_scripts_run_from_another_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-I", str(HERE / "__main__.py"), "mutation", "--help"]
    assert "--sample" in subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout


def test_the_export_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [])
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "tools.export_networks", raising=False)
    with pytest.raises(SystemExit, match="2"):
        main(["export_networks", str(tmp_path)])
    assert "no module onnx: pip install torch" in capsys.readouterr().err


def test_unknown_scripts_are_refused() -> None:
    with pytest.raises(SystemExit, match="there is no script benchmarks kills"):
        main(["benchmarks", "kills"])
