"""Plugins in environments of their own, which are really made: by pip, from source trees, without a network."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pano_mvs_environments.build import build, python_in
from pano_mvs_environments.index import MARK, environments
from pano_mvs_environments.install import install_plugin
from pano_mvs_environments.sources import plugin_source
from pano_mvs_environments.stages import plugin_environments
from plugin_trees import STAGE, write_library, write_plugin, write_project

import pano_mvs as product
from pano_mvs.api import InputError
from pano_mvs.cli.doctor.checks import plugin_findings
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.session.session import presets_folder
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.cli.conftest import Command, deliverables, run_json
from tests.docs.pages import block

pytestmark = pytest.mark.slow
WORKFLOW = """\
pano_mvs: 1
stages:
  images: {{use: source.folder, path: {images}}}
  one:    {{use: export.one, text: hello}}
  two:    {{use: export.two, times: 2}}
"""
SLOW = """
import time
from pano_mvs.api import Context, Each, Files, Panorama, stage


@stage("export.slow")
def slow(panorama: Each[Panorama], ctx: Context) -> Files:
    \"\"\"Take for ever.\"\"\"
    (ctx.scratch.parents[1] / "started").touch()
    time.sleep(1000)
    return Files({})
"""

SOURCE = '''
from pano_mvs.api import InputError, Panorama, Params, SourceItem, SourcePath, decode_image, is_only_planned, source


class ListedParams(Params):
    path: SourcePath


def listed(params):
    if not params.path.is_dir():
        raise InputError(f"{params.path}: is not a folder. Correct the path")
    if params.path.name == "broken":
        raise RuntimeError("no luck")
    for path in sorted(params.path.glob("*.png")):
        yield SourceItem(path.name, {"image": path}, notes=("planned" if is_only_planned.get() else "run",))


@source("source.listed", list_items=listed)
def read(item: SourceItem, params: ListedParams) -> Panorama:
    """Read a panorama."""
    return Panorama(item.file("image"), (32, 64), (32, 64))
'''


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with two plugins that need different versions of a library; both are installed.

    The second has a source and a stage that takes for ever as well.
    """
    folder = tmp_path_factory.mktemp("a  place für plugins")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", str(folder / "environments"))
        for name, version in (("one", "1.0"), ("two", "2.0")):
            library = write_library(folder / f"shared lib {version}", version)
            more = f"{SLOW}\n{SOURCE}" if name == "two" else ""
            text = f"{STAGE.format(name=name, title=name.capitalize())}\n{more}"
            installed = install_plugin(write_plugin(folder / name, name, library, text=text))
            others = {"export.slow", "source.listed"} if more else set()
            assert (installed.environment, {*installed.stages}) == ("overlay", {f"export.{name}", *others})
        images = sorted((tiny_capture(Variant((32, 64))).folder / "images").iterdir())
        (folder / "photos").mkdir()
        for path in images[:2]:
            shutil.copy(path, folder / "photos")
        yield folder


@pytest.fixture
def installed(made: Path, pano_mvs: Command, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the two plugins; the current folder has a workflow that uses both."""
    monkeypatch.setenv("PANO_MVS_ENVIRONMENTS", str(made / "environments"))
    Path("wf.yaml").write_text(WORKFLOW.format(images=json.dumps(str(made / "photos"))))
    return made


def units(summary: dict[str, object]) -> dict[str, tuple[int, int]]:
    """Return the number of units of each stage that a run computed, and of those that were cached."""
    stages = summary["stages"]
    assert isinstance(stages, list)
    return {one["name"]: (one["run"], one["cached"]) for one in stages}


def test_two_versions_of_a_library_work_in_one_run(installed: Path, pano_mvs: Command) -> None:
    result = pano_mvs("run", "wf.yaml", "--executor", "serial")
    assert result.code == 0, result.text
    found = {name: text for name, text in deliverables(Path("out/wf")).items() if name.endswith(".txt")}
    assert {text for name, text in found.items() if name.startswith("one/")} == {b"hello by 1.0"}
    assert {text for name, text in found.items() if name.startswith("two/")} == {b"seenseen by 2.0"}
    assert "note: written by version 1.0" in result.flat
    assert not {"shared_lib", "one", "two"} & set(sys.modules)
    again = pano_mvs("run", "wf.yaml", "--executor", "serial")
    assert "0 units computed" in again.flat
    no_processes_in(installed)
    for executor in ("processes", "dask"):
        own = ("--executor", executor, "--workers", "1")
        other = pano_mvs("run", "wf.yaml", *own, "--cache", executor, "--out", f"out/{executor}")
        assert other.code == 0, other.text
        assert {n: t for n, t in deliverables(Path("out", executor)).items() if n.endswith(".txt")} == found
        no_processes_in(installed)
    isolated = ("--executor", "processes", "--workers", "1", "--isolate", "--cache", "i", "--out", "out/i")
    alone = pano_mvs("run", "wf.yaml", *isolated, "--only", "one:000.png")
    assert alone.code == 0, alone.text
    in_one = {name: text for name, text in found.items() if name.startswith("one/000")}
    assert {name: text for name, text in deliverables(Path("out/i")).items() if name.endswith(".txt")} == in_one


def test_what_is_wrong_is_said_as_of_any_stage(installed: Path, pano_mvs: Command) -> None:
    said = {
        "one.text=longer than twenty letters": "--set one.text: stage 'one': text: must be short (got",
        "one.times=10": "--set one.times: stage 'one': times: Input should be less than or equal to 9 (got 10)",
        "one.timse=1": "stage 'one': unknown setting 'timse'. Did you mean 'times'?",
    }
    for override, text in said.items():
        result = pano_mvs("check", "wf.yaml", "--set", override)
        assert (result.code, text in result.flat) == (2, True), result.text
    result = pano_mvs("run", "wf.yaml", "--executor", "serial", "--set", "one.text=bad")
    assert result.code == 3
    assert "failed one:000.png: photos/bad.jpg: cannot be used. Remove it" in result.flat
    failure = run_json(Path("out/wf"))["failures"][0]
    assert "Traceback" not in json.dumps(failure)


def test_settings_are_asked_about_once(installed: Path, pano_mvs: Command) -> None:
    """The stage has a validator, which only its own process can call; that takes two seconds."""
    assert pano_mvs("check", "wf.yaml", "--set", "one.text=once").code == 0
    started = time.perf_counter()
    assert pano_mvs("check", "wf.yaml", "--set", "one.text=once").code == 0
    assert time.perf_counter() - started < 1.5


def copy_instead_of_pip(monkeypatch: pytest.MonkeyPatch, environment: Path, package: Path) -> None:
    """Let what is installed be a copy of an environment with the code of a package, which saves the work of pip."""

    def copied(folder: Path, *_: object) -> None:
        shutil.copytree(environment, folder, symlinks=True)
        (there,) = folder.rglob(f"{package.name}/__init__.py")
        shutil.rmtree(there.with_name("__pycache__"), ignore_errors=True)
        shutil.copy(package / "__init__.py", there)

    monkeypatch.setattr("pano_mvs_environments.install.build", copied)


def test_changed_code_has_other_keys(
    installed: Path, tmp_path: Path, pano_mvs: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert pano_mvs("run", "wf.yaml", "--executor", "serial").code == 0
    source = installed / "one" / "one" / "__init__.py"
    before, folder = source.read_text(), environments()[0].folder
    kept = shutil.copytree(folder, tmp_path / "kept", symlinks=True)
    copy_instead_of_pip(monkeypatch, kept, source.parent)
    assert not install_plugin(installed / "one").is_new
    try:
        source.write_text("# only a comment\n" + before)
        assert install_plugin(installed / "one").is_new
        result = pano_mvs("run", "wf.yaml", "--executor", "serial")
        assert "0 units computed" in result.flat
        source.write_text(before.replace(" by ", " with "))
        assert install_plugin(installed / "one").is_new
        assert not Path(folder).exists()
        assert pano_mvs("run", "wf.yaml", "--executor", "serial").code == 0
        counts = units(run_json(Path("out/wf")))
        assert [run > 0 for run, _ in (counts["one"], counts["two"])] == [True, False]
        assert b"hello with 1.0" in deliverables(Path("out/wf")).values()
    finally:
        source.write_text(before)
        install_plugin(installed / "one")


def test_a_broken_environment_is_found_and_made_again(installed: Path, pano_mvs: Command) -> None:
    assert pano_mvs("check", "wf.yaml").code == 0  # its process is asked now
    (one,) = (one for one in environments() if one.name == "one")
    library = next(Path(one.folder).rglob("shared_lib"))
    shutil.rmtree(library)
    found = {finding.what: finding for finding in plugin_findings(Registry.installed(), presets_folder())}
    assert (found["one 1.0"].state, found["two 1.0"].state) == ("warning", "ok")
    assert "No module named 'shared_lib'" in found["one 1.0"].detail
    assert found["one 1.0"].remedy == f"run `pano-mvs plugin install '{installed / 'one'}'`, which makes it again"
    for own in (("--executor", "serial"), ("--executor", "processes", "--workers", "1")):
        result = pano_mvs("run", "wf.yaml", *own, "--keep-going", "--cache", own[1])
        assert result.code == 3, result.text
        assert "failed one:000.png: the environment of the plugin one 1.0 cannot be used" in result.flat
        assert "which makes it again" in result.flat
        assert units(run_json(Path("out/wf")))["two"][0] > 0
    assert install_plugin("one").is_new  # the same digest, but it does not work
    assert not [found.problem for found in plugin_environments(check=True) if found.problem]


def test_a_unit_that_takes_too_long_is_ended(installed: Path, pano_mvs: Command) -> None:
    images = json.dumps(str(installed / "photos"))
    stages = f"images: {{use: source.folder, path: {images}}}\n  slow: {{use: export.slow, timeout_s: 2}}\n"
    Path("slow.yaml").write_text(f"pano_mvs: 1\nstages:\n  {stages}")
    result = pano_mvs("run", "slow.yaml", "--executor", "processes", "--workers", "1", "--only", "slow:000.png")
    assert result.code == 3, result.text
    assert "it took longer than timeout_s: 2, and was ended" in result.flat
    no_processes_in(installed)
    interrupt_a_serial_run()
    no_processes_in(installed)


def no_processes_in(folder: Path) -> None:
    listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(folder / "environments") not in listed


def interrupt_a_serial_run() -> None:
    """Interrupt a run in the middle of a unit of an environment."""
    command = [sys.executable, "-m", "pano_mvs", "run", "slow.yaml", "--executor", "serial", "--cache", "interrupted"]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 60.0
    while not list(Path("interrupted").rglob("started")) and time.monotonic() < deadline:
        time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    said, _ = run.communicate(timeout=60.0)
    assert run.returncode == 130, said


PLAIN = STAGE.replace("import shared_lib\n", "").format(name="bad", title="Bad")
COST = """
from pano_mvs.api import register_sweep_cost


@register_sweep_cost("rank2")
def rank(reference, warped, window): ...
"""
OWN_KIND = """
from dataclasses import dataclass
from pano_mvs.api import Each, Panorama, Record, stage


@dataclass(frozen=True)
class Own(Record):
    value: int


@stage("export.bad")
def bad(panorama: Each[Panorama]) -> Own:
    \"\"\"Return something else.\"\"\"
    return Own(1)
"""
BAD_PLUGINS = {
    "broken": (
        "import nothing_there\n",
        "its code failed to load: ModuleNotFoundError: No module named 'nothing_there'",
    ),
    "empty": ("VALUE = 1\n", "its modules define no stage"),
    "cost": (COST, "it registers the sweep cost 'rank2': a plugin with an environment of its own brings stages only"),
    "kind": (OWN_KIND, "the stage export.bad reads or returns Own, a kind of its own (bad): only the kinds of"),
    "memory": (
        PLAIN.replace('@stage("export.bad")', '@stage("export.bad", memory=lambda params, inputs: 5)'),
        "the stage export.bad declares its memory by a function",
    ),
    "needs": (
        PLAIN.replace('@stage("export.bad")', '@stage("export.bad", needs={"nowhere": "nowhere-lib"})'),
        "the stage export.bad needs nowhere-lib: add this to `dependencies`",
    ),
    "built in": (PLAIN.replace("export.bad", "export.ply"), "stage 'export.ply' is defined twice"),
    "other": (PLAIN.replace("export.bad", "export.one"), "the stage 'export.one' is defined by one 1.0 too"),
}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The environment of a plugin, before it is asked what it holds."""
    folder = tmp_path_factory.mktemp("built")
    build(folder / "environment", plugin_source(str(write_plugin(folder / "bad", "bad", None, text=PLAIN))), "overlay")
    return folder / "environment"


@pytest.mark.parametrize(("text", "why"), BAD_PLUGINS.values(), ids=BAD_PLUGINS)
def test_a_plugin_that_cannot_have_an_environment_is_refused(
    installed: Path, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, text: str, why: str
) -> None:
    plugin = write_plugin(tmp_path / "bad", "bad", None, text=text)
    copy_instead_of_pip(monkeypatch, built, plugin / "bad")
    before = sorted((installed / "environments").iterdir()), (installed / "environments/environments.json").read_text()
    with pytest.raises(InputError) as raised:
        install_plugin(plugin)
    assert why in str(raised.value)
    after = sorted((installed / "environments").iterdir()), (installed / "environments/environments.json").read_text()
    assert after == before


def test_requirements_that_cannot_be_met_are_said_with_the_reason_of_pip(
    installed: Path, tmp_path: Path, pano_mvs: Command
) -> None:
    write_plugin(tmp_path / "bad", "bad", tmp_path / "no such library")
    result = pano_mvs("plugin", "install", tmp_path / "bad")
    assert result.code == 2, result.text
    assert "error: the environment of bad cannot be made; nothing was changed: ERROR: " in result.flat
    assert "no such library" in result.flat
    assert "WARNING" not in result.flat
    write_project(tmp_path / "library", "other-lib", text="").joinpath("backend.py").write_text("1 / 0\n")
    write_plugin(tmp_path / "bad", "bad", None).joinpath("pyproject.toml").write_text(
        (tmp_path / "bad/pyproject.toml").read_text().replace(">=0.1", f">=0.1', 'other-lib @ {library_uri(tmp_path)}")
    )
    result = pano_mvs("plugin", "install", tmp_path / "bad")
    assert (result.code, "ZeroDivisionError" in result.text) == (2, True), result.text
    assert {one.name for one in environments()} == {"one", "two"}
    assert all(Path(one.python).exists() for one in environments())


def library_uri(folder: Path) -> str:
    return (folder / "library").as_uri()


def test_what_an_interrupted_installation_left_is_removed(installed: Path, tmp_path: Path) -> None:
    """Two processes at once install two plugins; a third was killed before."""
    plugins = [write_plugin(tmp_path / name, name, None, text=stage_named(name)) for name in ("three", "four")]
    command = [sys.executable, "-m", "pano_mvs", "plugin", "install"]
    killed = subprocess.Popen([*command, str(plugins[0])])
    folder = installed / "environments"
    while not list(folder.glob("three-*")):
        assert killed.poll() is None
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    assert list(folder.glob("three-*"))
    running = [subprocess.Popen([*command, str(plugin)]) for plugin in plugins]
    assert [one.wait() for one in running] == [0, 0]
    assert {one.name for one in environments()} == {"one", "two", "three", "four"}
    assert {Path(one.folder) for one in environments()} == {path for path in folder.iterdir() if path.is_dir()}
    for name in ("three", "four"):
        product.remove_plugin(name)
    assert {one.name for one in environments()} == {"one", "two"}


def stage_named(name: str) -> str:
    return STAGE.replace("import shared_lib\n", "").format(name=name, title=name.capitalize())


def test_a_source_lists_its_items_in_its_own_process(installed: Path, pano_mvs: Command) -> None:
    shutil.copytree(installed / "photos", "photos")
    Path("listed.yaml").write_text(
        "pano_mvs: 1\nstages:\n  images: {use: source.listed, path: photos}\n  two: {use: export.two}\n"
    )
    result = pano_mvs("run", "listed.yaml", "--executor", "serial")
    assert result.code == 0, result.text
    count = len(list(Path("photos").glob("*.png")))
    assert units(run_json(Path("out/listed"))) == {"images": (count, 0), "two": (count, 0)}
    assert "note: run" in result.flat
    result = pano_mvs("plan", "listed.yaml")
    assert (result.code, "nothing to compute" in result.flat) == (0, True), result.text
    Path("photos").rename("broken")
    result = pano_mvs("plan", "listed.yaml", "--set", "images.path=broken")
    assert result.code == 2
    assert "error: source source.listed cannot list its items: " in result.flat
    assert re.search(r"two/__init__\.py:\d+: RuntimeError: no luck", result.flat), result.text
    result = pano_mvs("plan", "listed.yaml", "--set", "images.path=wf.yaml")
    assert (result.code, "wf.yaml: is not a folder. Correct the path" in result.flat) == (2, True), result.text


def test_an_isolated_environment_sees_pano_mvs_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its requirements, a gigabyte, are not installed here: what would install them is replaced."""
    asked = tmp_path / "asked.txt"
    uv = tmp_path / "bin" / "uv"
    uv.parent.mkdir()
    uv.write_text(
        f'#!/bin/sh\necho "$@" >> {asked}\n'
        f'if [ "$1" = venv ]; then exec {sys.executable} -m venv --without-pip "$6"; fi\n'
    )
    uv.chmod(0o755)
    monkeypatch.setenv("PATH", str(uv.parent), prepend=os.pathsep)
    source = plugin_source(str(write_plugin(tmp_path / "one", "one", None, environment="isolated")))
    folder = tmp_path / "environment"
    build(folder, source, "isolated")
    python = python_in(folder)
    first, second = asked.read_text().splitlines()
    assert first == f"venv --quiet --allow-existing --python {sys.executable} {folder}"
    same = f"pano-mvs=={product.__version__}"
    assert second == f"pip install --quiet --python {python} {same} one @ {(tmp_path / 'one').as_uri()}"
    code = (
        "import importlib.util, pano_mvs; from importlib.metadata import entry_points, requires, version\n"
        "print(pano_mvs.__file__, version('pano-mvs'), len(requires('pano-mvs')) > 9,"
        " len(entry_points(group='pano_mvs.plugins')) > 5, importlib.util.find_spec('numpy'))"
    )
    done = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [product.__file__, product.__version__, "True", "True", "None"]
    assert (folder / MARK).is_file()


def test_a_plugin_without_an_environment_is_installed_beside_pano_mvs(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pano_mvs: Command
) -> None:
    """What would change this installation is replaced."""
    calls: list[list[str]] = []
    monkeypatch.setattr("pano_mvs_environments.install.run_command", lambda command: calls.append(list(command)))
    monkeypatch.setattr("shutil.which", lambda name: None)
    plugin = write_plugin(tmp_path / "plain", "pano-mvs-queues", None, environment="")
    with pytest.raises(Exception, match="No package metadata"):
        install_plugin(plugin)
    (command,) = calls
    assert command[:6] == [sys.executable, "-P", "-m", "pip", "--python", sys.executable]
    assert command[-1] == f"pano-mvs-queues @ {plugin.as_uri()}"
    calls.clear()
    with pytest.raises(InputError, match="numpy is not a plugin of pano_mvs, which was installed before"):
        install_plugin("numpy")
    assert len(calls) == 1  # it is not removed
    result = pano_mvs("plugin", "install", installed / "one", "--environment", "none")
    assert result.code == 2
    assert "one is installed in an environment of its own: run `pano-mvs plugin remove one` first" in result.flat


def test_stages_in_environments_have_the_code_that_they_have_there(installed: Path) -> None:
    """The key of a unit is made here, and checked in the worker: both must find the same code and libraries."""
    code = (
        "import json; from pano_mvs.engine.stages.registry import Registry\n"
        "from pano_mvs.engine.stages.stage_code import stage_code\n"
        "spec = Registry.installed().stages['export.one']\n"
        "found = stage_code(spec, spec.params_type()); print(json.dumps([found.digest, dict(found.libraries)]))"
    )
    python = next(one.python for one in environments() if one.name == "one")
    done = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, check=True)
    remote = Registry.installed().stages["export.one"].remote
    assert remote is not None
    assert json.loads(done.stdout) == [remote.code().digest, dict(remote.code().libraries)]
    assert remote.code().libraries["shared_lib"] == "1.0"


def test_the_commands_in_the_guide_work(installed: Path, pano_mvs: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package that `plugin new` writes is installed, passes its own tests there, and is removed."""
    monkeypatch.setattr("pano_mvs.cli.doctor.libraries._LIBRARIES", ())  # each is tried in a process of its own
    monkeypatch.setenv("PIP_NO_BUILD_ISOLATION", "0")  # pip reads this as a yes; hatchling is installed here
    commands = [command.split()[1:] for command in block("plugins.md", "environment").splitlines()]
    assert [command[:2] for command in commands][:2] == [["plugin", "new"], ["plugin", "install"]]
    for command in commands:
        as_json = ["--json"] if command[:2] in (["plugin", "install"], ["plugin", "remove"]) else []
        result = pano_mvs(*command, *as_json)
        assert result.code == 0, result.text
        if command[:2] == ["plugin", "install"]:
            made = json.loads(result.text)
            assert (made["name"], made["environment"], made["stages"]) == ("cut", "overlay", ["filters.cut"])
            check_own_tests()
        elif command[0] == "stage":
            assert "filters.cut version 1 from cut 0.1.0" in result.flat
        elif command[0] == "doctor":
            assert "1 stage in an environment of its own" in result.flat.replace("│", "").replace("  ", " ")
    assert json.loads(result.text)["folder"] == made["folder"]
    assert not Path(made["folder"]).exists()
    assert {one.name for one in environments()} == {"one", "two"}


def check_own_tests() -> None:
    """Run the tests that `plugin new` has written, in the environment of the package."""
    python = next(one.python for one in environments() if one.name == "cut")
    tests = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "cut/test_cut.py"]
    done = subprocess.run(tests, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0, done.stdout + done.stderr
