"""Stages whose code is not imported here: a plugin provides them by a function, and computes their units elsewhere."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from pano_mvs.cli.doctor.checks import plugin_findings
from pano_mvs.core.errors import WorkflowError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.processes import WorkerProcess
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage_code import code_of_package, module_version, package_code, stage_code
from pano_mvs.session.session import open_session
from tests.cli.conftest import Command
from tests.plugin_packages import Packages

STAGES = '''
from pano_mvs.api import Context, Each, Files, Panorama, stage


@stage("export.noted")
def noted(panorama: Each[Panorama], ctx: Context) -> Files:
    """Write a note."""
    (ctx.scratch / "note.txt").write_text("here")
    return Files({"notes/{item}.txt": ctx.scratch / "note.txt"})
'''
PROVIDER = """
from dataclasses import replace
from pano_mvs.engine.executors.execute import unit_outcome
from pano_mvs.engine.stages.registry import Plugin, PluginProblem, ProvidedPlugin
from pano_mvs.engine.stages.stage import StageCode, spec_of
import elsewhere

calls = []


class Remote:
    def code(self):
        return StageCode("0" * 32, {"far": "1.0"})

    def outcome(self, unit, store, *, threads, log):
        calls.append(unit.item)
        here = replace(unit, entry=replace(unit.entry, spec=spec_of(elsewhere.noted)))
        return unit_outcome(here, store, threads=threads, log=log)

    def close(self):
        calls.append("closed")


def stages():
    spec = replace(spec_of(elsewhere.noted), remote=Remote())
    names = (("stage", "export.noted"),)
    yield ProvidedPlugin(Plugin("far 1.0", names, environment="/far", check=lambda: None), (spec,))
    problem = PluginProblem("its environment is gone", "run `make it`")
    gone = (("stage", "export.gone"),)
    yield ProvidedPlugin(Plugin("gone 1.0", gone, str(problem), environment="/gone", check=lambda: problem))
"""
WORKFLOW = "pano_mvs: 1\nstages:\n  images: {{use: source.folder, path: {images}}}\n  noted: {{use: export.{stage}}}\n"


@pytest.fixture
def far(packages: Packages) -> Packages:
    """A plugin that provides a stage, and one that it cannot provide."""
    packages.add("far", {"plugins": {"far": "far_provider:stages"}}, far_provider=PROVIDER, elsewhere=STAGES)
    return packages


def test_units_are_computed_by_the_plugin(far: Packages, rendered: Path, tmp_path: Path) -> None:
    (tmp_path / "wf.yaml").write_text(WORKFLOW.format(images=rendered / "images", stage="noted"))
    session = open_session(str(tmp_path / "wf.yaml"), cache=tmp_path / "cache", out=tmp_path / "out")
    store = Store(session.store_root)
    run = Run(session.workflow, session.graph, store, out=session.out, executor=(executor := SerialExecutor(store)))
    assert run.execute().exit_code == 0
    executor.close()
    executor.close()
    calls = sys.modules["far_provider"].calls
    assert sorted(calls[:4]) == ["000.png", "001.png", "002.png", "003.png"]
    assert calls[4:] == ["closed"]
    assert len(list((tmp_path / "out" / "notes").iterdir())) == 4
    spec = session.workflow.stages["noted"].spec
    assert stage_code(spec, spec.params_type()).libraries == {"far": "1.0"}
    assert not spec.is_built_in


def test_what_is_not_there_says_why(far: Packages, rendered: Path, tmp_path: Path) -> None:
    (tmp_path / "wf.yaml").write_text(WORKFLOW.format(images=rendered / "images", stage="gone"))
    with pytest.raises(WorkflowError, match=r"gone 1.0 cannot be used: its environment is gone\. Run `make it`"):
        open_session(str(tmp_path / "wf.yaml"), cache=tmp_path / "cache", out=tmp_path / "out")
    assert "gone" not in Registry.installed().suggest("export.nothing").partition("\n")[0]


def test_plugins_and_doctor_show_environments(far: Packages, pano_mvs: Command, tmp_path: Path) -> None:
    found = json.loads(pano_mvs("plugins", "--json").text)
    rows = {row["plugin"]: row for row in found["plugins"]}
    assert rows["far 1.0"] == {
        "plugin": "far 1.0",
        "from": "environment",
        "environment": "/far",
        "state": "ok",
        "brings": {"stage": ["export.noted"]},
    }
    assert (rows["gone 1.0"]["state"], rows["pano-mvs 0.1.0"]["environment"]) == ("broken", None)
    assert {"stage": "export.noted", "version": 1, "from": "far 1.0", "summary": "Write a note."} in found["stages"]
    assert found["problems"] == ["the plugin gone 1.0 cannot be used: its environment is gone. Run `make it`"]
    assert "stage export.noted; in /far" in pano_mvs("plugins").flat
    assert pano_mvs("plugins", "--check", "--json").code == 2
    findings = {one.what: one for one in plugin_findings(Registry.installed(), tmp_path, {})}
    assert (findings["far 1.0"].state, findings["far 1.0"].remedy) == ("ok", "")
    assert findings["far 1.0"].detail == "1 stage in an environment of its own, /far"
    gone = findings["gone 1.0"]
    assert (gone.state, gone.detail, gone.remedy) == ("warning", "its environment is gone", "run `make it`")


def test_a_provider_that_fails_disables_its_plugins_alone(packages: Packages) -> None:
    packages.add("far", {"plugins": {"far": "far_bad:stages"}}, far_bad="def stages():\n    yield 1 / 0\n")
    registry = Registry.installed()
    assert [plugin.origin for plugin in registry.broken] == ["far 1"]
    assert "source.folder" in registry.stages


def test_a_name_that_is_provided_and_defined_is_neithers(far: Packages, mine: Path) -> None:
    (mine / "noted.py").write_text(STAGES)
    registry = Registry.installed()
    assert "'export.noted' is defined twice" in registry.suggest("export.noted")


def test_the_code_of_a_package_is_the_same_for_a_process_that_does_not_import_it(packages: Packages) -> None:
    (packages.folder / "shop").mkdir()
    (packages.folder / "shop" / "__init__.py").write_text("from .parts import noted\n")
    (packages.folder / "shop" / "parts.py").write_text(f"import numpy\n{STAGES}")
    packages.add("shop", {"plugins": {"shop": "shop"}})
    spec = Registry.installed().stages["export.noted"]
    here = stage_code(spec, spec.params_type())
    described = package_code("shop.parts")
    assert set(described.files) == {"shop/parts.py"}
    assert code_of_package(described, module_version) == here
    assert {"numpy", "shop"} <= here.libraries.keys()
    other = code_of_package(described, lambda module: "9")
    assert (other.digest, set(other.libraries.values())) == (here.digest, {"9"})


def test_a_compiled_package_has_its_version_alone() -> None:
    code = package_code("sys")
    assert not code.files
    assert code_of_package(code, lambda module: f"{module} 1").libraries == {"sys": "sys 1"}


def test_a_worker_can_be_one_of_another_interpreter(tmp_path: Path) -> None:
    """It starts with the interpreter, its options and its variables; what it says when it cannot is kept."""
    script = tmp_path / "python.py"
    script.write_text("import os, sys\nprint(sys.argv, os.environ['COLOUR'], file=sys.stderr)\nsys.exit(3)\n")
    worker = WorkerProcess(
        1, tmp_path / "errors.txt", python=(sys.executable, str(script), "-I"), variables={"COLOUR": "blue"}
    )
    request = {"unit": {"key": "0"}, "timeout_s": 0.0, "fresh": False}
    outcome = worker.run(request)
    assert worker.refused
    assert "blue" in outcome.cause
    assert "'-I', '-X', 'faulthandler', '-c'" in outcome.cause
    assert "COLOUR" not in os.environ
    worker.stop()
