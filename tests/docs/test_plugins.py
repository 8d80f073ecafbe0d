"""What docs/plugins.md shows is what `plugin new` writes, which tests/cli/test_plugin_new.py runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs import api
from pano_mvs.cli.app import app
from pano_mvs.cli.plugins.new import KINDS, rendered
from pano_mvs.engine.stages.plugin_files import declared_names
from pano_mvs.scene import Record

PAGE = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text(encoding="utf-8")
PLUGINS = {
    kind: (name, text)
    for kind, name, text in re.findall(r"<!-- plugin: (\w+) (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL)
}


def block(mark: str) -> str:
    found = re.search(rf"<!-- {mark} -->\n```\w*\n(.*?)```", PAGE, re.DOTALL)
    assert found, mark
    return found.group(1)


def test_the_page_has_one_plugin_of_each_kind() -> None:
    assert PLUGINS.keys() == KINDS.keys()


@pytest.mark.parametrize("kind", KINDS)
def test_a_plugin_on_the_page_is_what_is_written(kind: str) -> None:
    name, text = PLUGINS[kind]
    assert text == rendered(kind, name)[0]
    assert [given.rpartition(".")[2] for _, given in declared_names(text)] == [name]


def test_commands_on_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for command in block("commands").splitlines():
        program, *arguments = command.split()
        if program == "pano-mvs":
            assert CliRunner().invoke(app, arguments).exit_code == 0
        else:
            assert program == "pytest"
            assert Path(arguments[0]).is_file()


def test_the_test_on_the_page_is_what_is_written() -> None:
    lines = block("test").splitlines()
    assert set(lines) <= set(rendered("filter", "any")[1].splitlines())


def test_the_kinds_on_the_page_are_those_of_the_api() -> None:
    listed = re.search(r"The kinds are records in `pano_mvs.api`: (.*?);", PAGE, re.DOTALL)
    assert listed
    kinds = {
        name for name in api.__all__ if isinstance(value := getattr(api, name), type) and issubclass(value, Record)
    }
    assert set(re.findall(r"`(\w+)`", listed.group(1))) == kinds - {"Record"}
