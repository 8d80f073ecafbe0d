"""Where plugins come from, and that a bad one harms nobody until one of its names is used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.errors import PluginError, UsageError, WorkflowError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.plugin_folders import plugin_files_in, user_plugin_folders
from pano_mvs.engine.stages.registry import Registry
from tests.engine.conftest import Toy, ran

STAGE = """\
from pano_mvs.api import Each, RangeMap, stage

@stage("{name}")
def same(x: Each[RangeMap]) -> RangeMap:
    \"\"\"As it is.\"\"\"
    return x
"""
BROKEN = "from pano_mvs.api import *\nLIMIT = 1 / 0\n" + STAGE.format(name="filters.unlucky")


def command(*arguments: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, " ".join(result.output.split())


def test_a_file_in_the_users_folder_is_a_plugin(mine: Path) -> None:
    (mine / "same.py").write_text(STAGE.format(name="filters.same"))
    (mine / "_helper.py").write_text("raise RuntimeError\n")
    (mine / "test_same.py").write_text("raise RuntimeError\n")
    registry = Registry.installed()
    assert registry.broken == []
    assert registry.origins["filters.same"] == str(mine / "same.py")
    first = registry.stages["filters.same"].code_digest
    assert first
    (mine / "same.py").write_text("# a comment\n" + STAGE.format(name="filters.same"))
    assert Registry.installed().stages["filters.same"].code_digest == first


def test_the_users_folder_is_that_of_the_platform(tmp_path: Path) -> None:
    several = os.pathsep.join([str(tmp_path), "", str(tmp_path / "b")])
    assert user_plugin_folders({"PANO_MVS_PLUGINS": several}) == [tmp_path, tmp_path / "b"]
    assert user_plugin_folders({"PANO_MVS_PLUGINS": ""}) == []
    (folder,) = user_plugin_folders({"XDG_CONFIG_HOME": str(tmp_path), "APPDATA": str(tmp_path)})
    assert folder.parts[-2:] == ("pano-mvs", "plugins")
    assert folder.is_absolute()
    assert user_plugin_folders({"XDG_CONFIG_HOME": "relative"})[0].is_absolute()
    assert plugin_files_in(tmp_path / "gone") == []


@pytest.mark.parametrize(
    "broken",
    [
        BROKEN,
        "def f(:\n" + STAGE.format(name="filters.unlucky"),
        "import sys\nsys.exit(3)\n" + STAGE.format(name="filters.unlucky"),
        "raise BaseException\n" + STAGE.format(name="filters.unlucky"),
    ],
)
def test_a_broken_plugin_is_told_when_a_name_is_missing(mine: Path, broken: str) -> None:
    (mine / "bad.py").write_text(broken)
    (mine / "same.py").write_text(STAGE.format(name="filters.same"))
    registry = Registry.installed()
    assert "filters.same" in registry.stages
    told = registry.suggest("filters.unlucky")
    assert f"{mine / 'bad.py'} failed to load:" in told
    assert any(word in told for word in ("Traceback", "SyntaxError", "SystemExit", "BaseException"))
    assert "registry.py" not in told
    assert "stage_code.py" not in told


def test_the_traceback_of_a_broken_plugin_is_the_original_one(mine: Path) -> None:
    (mine / "bad.py").write_text(BROKEN)
    code, text = command("stage", "show", "filters.unlucky")
    assert code == 2
    assert f'File "{mine / "bad.py"}", line 2, in <module> LIMIT = 1 / 0' in text
    assert "ZeroDivisionError: division by zero" in text
    code, text = command("stage", "show", "filters.median")
    assert code == 0
    assert "bad.py" not in text


def test_a_workflow_without_several_stages_of_a_broken_plugin_says_once_why(mine: Path) -> None:
    (mine / "bad.py").write_text(BROKEN)
    workflow = mine.parent / "workflow.yaml"
    workflow.write_text(
        "stages:\n  one: {use: filters.unlucky}\n  two: {use: filters.lost}\n  three: {use: filters.x}\n"
    )
    code, text = command("check", str(workflow))
    assert code == 2
    assert text.count("there is no stage") == 3
    assert text.count("ZeroDivisionError: division by zero") == 1


def test_a_part_of_a_broken_plugin_says_why_it_is_not_there(mine: Path) -> None:
    (mine / "bad.py").write_text(
        "from pano_mvs.api import register_toy_part\n\n@register_toy_part('mine')\ndef f(): ...\n"
    )
    parts: NamedRegistry[int] = NamedRegistry("toy part", {"ours": 1})
    Registry.installed()
    with pytest.raises(UsageError, match=r"there is no toy part 'mine'.*\n.*bad\.py failed to load"):
        parts.check("mine")
    assert parts.check("ours") == "ours"
    (mine / "bad.py").unlink()
    Registry.installed()
    with pytest.raises(UsageError, match=r"there is no toy part 'mine'[^\n]*\Z"):
        parts.check("mine")


def test_a_name_that_two_plugins_give_is_neithers(mine: Path) -> None:
    own = STAGE.format(name="filters.own").replace("def same", "def own")
    (mine / "a.py").write_text(STAGE.format(name="filters.same") + own)
    (mine / "b.py").write_text(STAGE.format(name="filters.same"))
    (mine / "c.py").write_text(STAGE.format(name="filters.median"))
    registry = Registry.installed()
    assert registry.broken == []
    assert "filters.own" in registry.stages
    for name, first, second in [("filters.same", "a.py:3", "b.py:3"), ("filters.median", "filters.py:", "c.py:3")]:
        assert name not in registry.stages
        assert f"{name!r} is defined twice: " in registry.suggest(name)
        assert first in registry.suggest(name)
        assert second in registry.suggest(name)
    code, text = command("plugins")
    assert code == 0
    assert text.count("is defined twice") == 2


def test_a_workflows_file_may_not_take_an_installed_name(mine: Path, toy: Toy) -> None:
    (mine / "pairs.py").write_text(STAGE.format(name="toy.pairs"))
    with pytest.raises(WorkflowError, match=r"'toy.pairs' is defined twice: .*pairs\.py:3 and .*plug\.py"):
        toy.session()


def test_a_file_that_is_in_the_folder_and_named_by_the_workflow_is_one_plugin(mine: Path, toy: Toy) -> None:
    (mine / "plug.py").symlink_to(toy.folder / "plug.py")
    (mine / "_helper.py").write_text("")
    (toy.folder / "helper.py").rename(toy.folder / "_helper.py")
    toy.edit("plug.py", lambda text: text.replace("from helper", "from _helper"))
    assert len(toy.session().workflow.plugins) == 1


def test_a_plugin_of_the_folder_goes_along_to_workers(mine: Path, toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    (toy.folder / "plug.py").rename(mine / "plug.py")
    (toy.folder / "helper.py").rename(mine / "_helper.py")
    (mine / "plug.py").write_text((mine / "plug.py").read_text().replace("from helper", "from _helper"))
    (mine / "other.py").write_text(STAGE.format(name="filters.same"))
    toy.edit("wf.yaml", lambda text: text.replace("plugins: [plug.py]\n", ""))
    assert list(toy.session().workflow.plugins) == [mine / "plug.py"]
    assert ran(toy.run())["scaled"] == 5
    assert ran(toy.run()) == {}


def test_what_no_worker_needs_does_not_go_along(mine: Path, toy: Toy) -> None:
    """Libraries of an observer need not be installed where units are computed."""
    (mine / "bell.py").write_text(
        "from pano_mvs.session.observers import register_observer\n\n"
        '@register_observer("bell", help="Ring.")\ndef bell(values, run): ...\n'
    )
    (mine / "walk.py").write_text(
        "from pano_mvs.io.readers import register_pose_reader\n\n"
        '@register_pose_reader("walk", what="a walk", recognises=lambda path: False)\ndef walk(path): ...\n'
    )
    assert set(toy.session().workflow.plugins) == {toy.folder / "plug.py", mine / "walk.py"}


def test_a_relative_plugin_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "same.py").write_text("import pathlib\npathlib.Path('imported').touch()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PANO_MVS_PLUGINS", ".")
    (broken,) = Registry.installed().broken
    assert "not an absolute path" in broken.error
    assert not (tmp_path / "imported").exists()


@pytest.mark.slow
@pytest.mark.parametrize("start", [["-m", "pano_mvs"], ["-P", "-c", "from pano_mvs.cli.app import main; main()"]])
def test_nothing_is_imported_from_the_current_folder(tmp_path: Path, start: list[str]) -> None:
    trap = "import pathlib\npathlib.Path(__file__).with_suffix('.sprung').touch()\n"
    for name in ("json", "typer", "numpy", "trap", "sitecustomize", "conftest"):
        (tmp_path / f"{name}.py").write_text(trap)
    (tmp_path / "trap-1.dist-info").mkdir()
    (tmp_path / "trap-1.dist-info" / "METADATA").write_text("Name: trap\nVersion: 1\n")
    (tmp_path / "trap-1.dist-info" / "entry_points.txt").write_text("[pano_mvs.plugins]\ntrap = trap\n")
    result = subprocess.run([sys.executable, *start, "plugins"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "depth.sweep" in result.stdout
    assert list(tmp_path.glob("*.sprung")) == []


def test_commands_see_the_plugins_of_a_workflow(toy: Toy) -> None:
    workflow = toy.folder / "wf.yaml"
    assert command("stage", "show", "toy.scale")[0] == 2
    code, text = command("stage", "show", "toy.scale", "--workflow", workflow)
    assert code == 0
    assert "x: Each[Number]" in text
    assert command("stage", "show", "toy.scale", "--plugin", toy.folder / "plug.py")[0] == 0
    assert "toy.scale" in command("plugins", "--workflow", workflow)[1]
    toy.edit("wf.yaml", lambda text: text.replace("by: 3", "bye: 3"))
    assert command("stage", "show", "toy.scale", "--workflow", workflow)[0] == 0
    code, text = command("stage", "show", "toy.scael", "--workflow", workflow)
    assert code == 2
    assert "unknown setting 'bye'" in text


def test_plugins_are_listed_sound_or_broken(mine: Path) -> None:
    (mine / "bad.py").write_text(BROKEN)
    (mine / "nothing.py").write_text("x = 1\n")
    code, text = command("plugins")
    assert code == 0
    assert "pano-mvs 0" in text
    assert "bad.py failed to load:" in text
    assert "ZeroDivisionError: division by zero" in text
    assert "nothing.py failed to load:" in text
    assert "defines no stage" in text


def test_an_error_deep_in_a_named_plugin_is_shown_whole(toy: Toy) -> None:
    toy.edit("plug.py", lambda text: text + "\nimport json\nVALUES = json.loads('{')\n")
    with pytest.raises(WorkflowError, match=r"plug\.py:\d+: JSONDecodeError(?s:.*)Traceback"):
        toy.session()


def test_an_error_in_a_plugin_that_is_named_by_a_relative_path_has_its_line(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.edit("plug.py", lambda text: text + "\nNOTHING = 1 / 0\n")
    monkeypatch.chdir(toy.folder)
    with pytest.raises(PluginError, match=r"plug\.py:\d+: ZeroDivisionError"):
        Registry().add_file(Path("plug.py"))


def test_a_stage_for_every_image_needs_neighbours(toy: Toy) -> None:
    stage = '\n\n@stage("toy.lonely", every_image=True)\ndef lonely(x: Each[Number]) -> Number: ...\n'
    toy.edit("plug.py", lambda text: text + stage)
    with pytest.raises(PluginError, match=r"'toy.lonely' .* every_image needs ports annotated Each and Near"):
        Registry().add_file(toy.folder / "plug.py")


def test_what_a_plugin_prints_when_it_is_loaded_is_no_output_of_the_command(
    mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (mine / "chatty.py").write_text("print('hello')\n" + STAGE.format(name="filters.same"))
    assert "filters.same" in Registry.installed().stages
    assert capsys.readouterr().out == ""


def test_a_module_that_repeats_a_name_says_both_places(toy: Toy) -> None:
    toy.edit("plug.py", lambda text: text + '\n\n@stage("toy.pairs")\ndef more(names: Names[Number]) -> Pairs: ...\n')
    with pytest.raises(PluginError, match=r"'toy.pairs' is defined twice: .*plug\.py:\d+ and .*plug\.py:\d+"):
        Registry().add_file(toy.folder / "plug.py")


def test_a_command_of_a_plugin_takes_the_options_of_runs(mine: Path) -> None:
    (mine / "reveal.py").write_text(
        """\
from dataclasses import dataclass
from typing import Annotated

import typer

from pano_mvs.cli.commands import options_of_runs, register_command, takes_options
from pano_mvs.cli.options import takes_record
from pano_mvs.session.observers import register_observer

@register_observer("bell", help="Ring.")
def bell(values, run): ...

@register_observer("letter", help="Write.", metavar="URL")
def letter(values, run): ...

@dataclass(frozen=True)
class Arguments:
    name: Annotated[str, typer.Argument()]

@register_command("reveal")
@takes_options(options_of_runs)
@takes_record
def reveal(given: Arguments, options=None) -> None:
    print(given.name, dict(options))
"""
    )
    assert command("reveal", "x") == (0, "x {}")
    assert command("reveal", "x", "--bell", "--letter", "u") == (0, "x {'bell': (), 'letter': ('u',)}")
    assert "--letter" in command("reveal", "--help")[1]
    assert command("--help")[0] == 0
