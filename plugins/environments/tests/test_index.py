"""What a process knows of environments from their index, without starting anything."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pano_mvs_environments.index import (
    Environment,
    enter,
    environments,
    environments_folder,
    index_file,
    leave,
    sole_installation,
)
from pano_mvs_environments.install import install_plugin, remove_plugin
from pano_mvs_environments.settings import description_of
from pano_mvs_environments.sources import plugin_source, wish_of
from pano_mvs_environments.stages import plugin_environments, provided
from plugin_trees import write_plugin
from pydantic import Field

import pano_mvs
from pano_mvs.api import InputError, Params, UsageError
from pano_mvs.core.errors import PluginError, StoreError, WorkflowError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.workflow import load_workflow
from tests.cli.conftest import Command


class NotedParams(Params):
    times: int = Field(default=1, ge=1, le=9, description="how often")


def described(**changes: Any) -> dict[str, Any]:
    """Return what an interpreter says of the stage `export.noted`."""
    found = {
        "name": "export.noted",
        "version": 1,
        "doc": "Note something.",
        "origin": "noted.py:1",
        "module": "noted",
        "ports": [["panorama", "pano_mvs.scene.panorama:Panorama", "Each", False]],
        "output": "pano_mvs.scene.files:Files",
        "settings": description_of(NotedParams),
        "extras": {"params": "params", "ctx": "ctx"},
        "memory_bytes": 5,
        "every_image": False,
        "is_source": False,
        "code": {"files": {"noted/__init__.py": "0" * 32}, "outer": ["noted", "numpy", "pano_mvs.api"]},
    }
    return found | changes


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of all environments, which is empty at first."""
    folder = tmp_path / "environments"
    monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", str(folder))
    return folder


@pytest.fixture
def noted(home: Path) -> Environment:
    """The environment of a plugin as the index knows it: its interpreter is this one."""
    made = Environment(
        name="noted",
        version="1.0",
        mode="overlay",
        source="/my plugins/noted",
        folder=str(home / "noted"),
        python=sys.executable,
        python_version=sys.version.split()[0],
        pano_mvs=pano_mvs.__version__,
        installation=sys.prefix,
        digest="0" * 32,
        stages=(described(),),
        libraries={"noted": "1.0"},
    )
    enter(made)
    return made


def test_without_an_index_there_are_no_environments(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(provided()) == []
    monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", "")
    assert list(provided()) == []
    with pytest.raises(UsageError, match="is empty"):
        environments_folder()
    monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", "relative")
    with pytest.raises(UsageError, match="is not an absolute path"):
        environments()


def test_the_index_lies_among_the_settings_and_environments_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PANO_MVS_ENVIRONMENTS")
    for name in ("XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "settings"))
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path))
    folder, index = environments_folder(), index_file()
    assert index is not None
    assert index.parts[-2:] == ("pano-mvs", "environments.json")
    assert folder.parts[-3:-1] == ("pano-mvs", "environments")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "others"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "others"))
    assert environments_folder() != folder  # another index never removes its environments


def test_the_stages_in_the_index_are_known(noted: Environment) -> None:
    registry = Registry.installed()
    spec = registry.stages["export.noted"]
    assert (registry.origins["export.noted"], spec.doc, spec.memory_bytes) == ("noted 1.0", "Note something.", 5)
    assert not spec.is_built_in
    assert [str(port) for port in spec.ports] == ["panorama: Each[Panorama]"]
    assert spec.remote is not None
    code = spec.remote.code()
    assert code.libraries["noted"] == "1.0"
    assert code.libraries["numpy"]
    enter(replace(noted, libraries={"noted": "1.0", "numpy": "0.1"}))
    other = Registry.installed().stages["export.noted"].remote
    assert other is not None
    assert (other.code().digest, other.code().libraries["numpy"]) == (code.digest, "0.1")
    with pytest.raises(PluginError, match=r"export.noted can be called in .*noted only"):
        spec.function()


def test_an_isolated_environment_has_only_its_own_libraries(noted: Environment) -> None:
    enter(replace(noted, mode="isolated"))
    remote = Registry.installed().stages["export.noted"].remote
    assert remote is not None
    assert (remote.code().libraries["noted"], remote.code().libraries["numpy"]) == ("1.0", "not installed")


def test_a_workflow_names_the_line_of_a_wrong_setting(noted: Environment, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    text = (
        "pano_mvs: 1\nstages:\n  images: {use: source.folder, path: photos}\n  noted: {use: export.noted, times: 12}\n"
    )
    (tmp_path / "wf.yaml").write_text(text)
    with pytest.raises(WorkflowError, match=r"wf.yaml:4:37: stage 'noted': times: Input should be less than or equal"):
        load_workflow(tmp_path / "wf.yaml", Registry.installed())
    (tmp_path / "wf.yaml").write_text(text.replace("times: 12", "times: 2"))
    assert load_workflow(tmp_path / "wf.yaml", Registry.installed()).stages["noted"].spec.remote is not None


GONE = [
    ({"python": "/no/such/python"}, r"its environment /.*noted was removed"),
    ({"pano_mvs": "0.0.1"}, r"its environment was made for pano_mvs 0.0.1, and this is"),
    ({"python_version": "3.8.1"}, r"its environment was made for Python 3.8.1, and this is"),
]


@pytest.mark.parametrize(("changes", "why"), GONE, ids=["removed", "pano_mvs", "Python"])
def test_a_workflow_says_how_an_environment_is_made_again(
    noted: Environment, changes: dict[str, str], why: str, tmp_path: Path, pano_mvs: Command
) -> None:
    enter(replace(noted, **changes))  # type: ignore[arg-type]  # texts only
    stages = "images: {use: source.folder, path: .}\n  noted: {use: export.noted}"
    Path("wf.yaml").write_text(f"pano_mvs: 1\nstages:\n  {stages}\n")
    remedy = "Run `pano-mvs plugin install '/my plugins/noted'`, which makes it again"
    with pytest.raises(WorkflowError, match=rf"the plugin noted 1.0 cannot be used: {why}.*{remedy}"):
        load_workflow(Path("wf.yaml"), Registry.installed())
    assert pano_mvs("check", "wf.yaml", "--set", "noted=null").code == 0
    listed = pano_mvs("plugins", "--json")
    found = json.loads(listed.text)
    (row,) = (one for one in found["plugins"] if one["plugin"] == "noted 1.0")
    assert (row["from"], row["state"], row["environment"]) == ("environment", "broken", noted.folder)
    assert remedy in found["problems"][-1]
    assert [one.problem for one in plugin_environments()] == [found["problems"][-1].partition("used: ")[2]]


def test_environments_of_other_installations_are_not_used(noted: Environment, tmp_path: Path) -> None:
    enter(replace(noted, name="theirs", installation=str(tmp_path)))
    assert [one.name for one in environments()] == ["noted"]
    enter(replace(noted, version="2.0"))
    assert [(one.name, one.version) for one in environments()] == [("noted", "2.0")]
    index = index_file()
    assert index is not None
    assert "theirs" in index.read_text()
    enter(replace(noted, name="gone", installation=str(tmp_path / "gone")))
    leave("noted")
    assert environments() == []
    assert "theirs" in index.read_text()
    assert "gone" not in index.read_text()


@pytest.mark.parametrize("text", ["{", "[]", '{"format": 99}', '{"format": 1, "environments": [{}]}'])
def test_a_damaged_index_disables_its_plugins_alone(home: Path, text: str) -> None:
    home.mkdir()
    (home / "environments.json").write_text(text)
    registry = Registry.installed()
    (broken,) = registry.broken
    assert broken.origin == "pano_mvs_environments"
    assert "environments.json" in broken.error
    assert "Remove" in broken.error
    assert "source.folder" in registry.stages


def test_inside_an_environment_there_are_no_others(noted: Environment, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(noted.folder)
    folder.mkdir()
    monkeypatch.setattr(sys, "prefix", str(folder))
    enter(replace(noted, installation=str(folder)))
    assert len(list(provided())) == 1
    (folder / "pano-mvs-environment").touch()
    assert list(provided()) == []


@pytest.mark.slow
def test_commands_read_the_index_and_nothing_else(noted: Environment) -> None:
    """A plan with built-in stages alone opens one file, and starts and imports nothing of an environment."""
    code = (
        "import sys\nopened = []\n"
        "sys.addaudithook(lambda name, found: opened.append(str(found[0])) if name in ('open', 'subprocess.Popen') "
        "else None)\n"
        "from pano_mvs.engine.stages.registry import Registry\nRegistry.installed()\n"
        f"print([one for one in opened if {noted.folder!r}[:-6] in one], 'noted' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"[{str(index_file())!r}] False"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", str(tmp_path / "file" / "below"))
    plugin = write_plugin(tmp_path / "one", "one", None)
    with pytest.raises(StoreError, match=r"/file cannot be written: File exists.*PANO_MVS_ENVIRONMENTS"):
        install_plugin(plugin)


def test_a_full_disk_is_named(home: Path) -> None:
    with pytest.raises(StoreError, match=r"No space left on device\. Free some space"), sole_installation():
        raise OSError(28, "No space left on device", "/some/file")


PROJECTS = [
    ("", "has no pyproject.toml"),
    ("[project", "is not valid TOML"),
    ("[project]\nversion = '1'", "states no `name`"),
    ("[project]\nname = 'a b'", "states no `name`"),
    ("project = 3", "states no `name`"),
    ("[project]\nname = 'one'", "is not a plugin of pano_mvs: it has no entry point"),
    (
        "[project]\nname = 'one'\n[tool.pano_mvs]\nenvironment = 'own'",
        "`environment` under .* must be 'overlay' or 'isolated', got 'own'",
    ),
]


@pytest.mark.parametrize(("text", "why"), PROJECTS)
def test_folders_that_are_no_plugins_are_refused(tmp_path: Path, text: str, why: str) -> None:
    if text:
        (tmp_path / "pyproject.toml").write_text(text)
    with pytest.raises(InputError, match=why):
        plugin_source(str(tmp_path))


def test_other_things_that_are_no_plugins_are_refused(home: Path, tmp_path: Path) -> None:
    (tmp_path / "filter.py").touch()
    with pytest.raises(InputError, match=r"filter.py: is not a wheel.*name it under `plugins:`"):
        plugin_source(str(tmp_path / "filter.py"))
    with pytest.raises(UsageError, match="is neither a folder"):
        plugin_source("./nowhere")
    with pytest.raises(UsageError, match="--environment mine: must be one of overlay, isolated, none"):
        wish_of(plugin_source("any-name"), "mine")


def test_a_plugin_is_installed_again_by_its_name(noted: Environment, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Noted was installed from /my plugins/noted, which does not exist"):
        plugin_source("Noted")
    write_plugin(tmp_path / "noted", "noted", None)
    enter(replace(noted, source=str(tmp_path / "noted")))
    assert plugin_source("NOTED").shown == str(tmp_path / "noted")
    enter(replace(noted, source="noted>=1", mode="isolated"))
    again = plugin_source("noted")
    assert (again.requirement, wish_of(again, ""), wish_of(again, "none")) == ("noted>=1", "isolated", None)


def test_what_is_no_plugin_is_not_removed(noted: Environment) -> None:
    for name in ("numpy", "pano-mvs", "nothing"):
        with pytest.raises(UsageError, match=rf"no plugin '{name}' is installed as a package.* Known: noted"):
            remove_plugin(name)
    others = environments_folder() / "documents"
    others.mkdir(parents=True)
    assert remove_plugin("Noted").name == "noted"
    assert environments() == []
    assert others.is_dir()  # the user may have chosen a folder that holds other things
