"""Executors of plugins compute what the built-in ones compute, with options of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import PluginError, UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import (
    EXECUTORS,
    ExecutorRequest,
    chosen,
    executor_options,
    executor_size,
    make_executor,
)
from tests.cli.conftest import Command, deliverables, run_json
from tests.engine.conftest import Toy
from tests.plugin_packages import Packages

FILE = '''\
from pano_mvs.core.doors import RunOption
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor, register_executor

PLACE = RunOption("{name}-place", "Note the units in this file.", "FILE")
LOUD = RunOption("{name}-loud", "Note what was asked.")


class Noting(SerialExecutor):
    """Computes each job when it is waited for, and notes it."""

    name = "{name}"

    def __init__(self, store, request):
        super().__init__(store, threads=request.threads)
        self.file = open(request.options["{name}-place"], "a")
        if "{name}-loud" in request.options:
            print(request.name, request.workers, dict(request.options), file=self.file)

    def submit(self, job):
        print(job.unit.entry.name, job.unit.item, file=self.file)
        super().submit(job)

    def close(self):
        print("closed", file=self.file)
        self.file.close()


@register_executor("{name}", options=(PLACE, LOUD))
def noting(store, request: ExecutorRequest) -> Noting:
    return Noting(store, request)
'''


@pytest.fixture
def notes(mine: Path) -> Path:
    """The folder of the user's plugins with one that brings an executor."""
    (mine / "notes.py").write_text(FILE.format(name="notes"))
    return mine


def test_the_executor_of_a_file_runs_a_workflow(toy: Toy, notes: Path, pano_mvs: Command) -> None:
    arguments = ("run", toy.folder / "wf.yaml", "--executor")
    assert pano_mvs(*arguments, "serial", "--out", "serial", "--cache", "a").code == 0
    result = pano_mvs(*arguments, "notes", "--notes-place", "notes.txt", "--out", "noted", "--cache", "b")
    assert result.code == 0, result.text
    assert deliverables(Path("noted")) == deliverables(Path("serial"))
    lines = Path("notes.txt").read_text().splitlines()
    assert len(lines) == 29  # 28 units
    assert {"images 1.txt", "scaled 5.txt"} <= set(lines)
    assert lines[-1] == "closed"
    assert run_json(Path("noted"))["exit_code"] == 0


def test_an_option_chooses_the_only_executor_that_has_it(toy: Toy, notes: Path, pano_mvs: Command) -> None:
    result = pano_mvs("run", toy.folder / "wf.yaml", "--notes-loud", "--notes-place", "a", "--notes-place", "b")
    assert result.code == 0, result.text
    assert not Path("a").exists()
    assert Path("b").read_text().splitlines()[0] == "notes 0 {'notes-place': 'b', 'notes-loud': ''}"
    text = pano_mvs("run", "--help").flat
    assert "Note the units in this file." in text
    assert "Note what was asked." in text


def test_an_option_of_another_executor_is_refused(toy: Toy, notes: Path, pano_mvs: Command) -> None:
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "serial", "--notes-place", "notes.txt")
    assert result.code == 2
    assert "--notes-place requires --executor notes; serial has no such option" in result.flat
    assert not Path("notes.txt").exists()
    assert not Path("out/toy/run.json").exists()


def test_an_option_of_two_executors_chooses_neither(toy: Toy, notes: Path, pano_mvs: Command) -> None:
    (notes / "more.py").write_text(FILE.format(name="notes").replace('_executor("notes"', '_executor("more"'))
    result = pano_mvs("run", toy.folder / "wf.yaml", "--notes-place", "notes.txt")
    assert result.code == 2
    assert "--notes-place requires --executor more or notes; serial has no such option" in result.flat


def test_the_variable_names_an_executor_of_a_plugin(
    toy: Toy, notes: Path, pano_mvs: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    (notes / "notes.py").write_text(FILE.format(name="notes").replace('["notes-place"]', '.get("notes-place", "n")'))
    monkeypatch.setenv("PANO_MVS_EXECUTOR", "notes")
    assert pano_mvs("run", toy.folder / "wf.yaml").code == 0
    assert Path("n").is_file()


def test_a_package_offers_an_executor_that_is_loaded_when_it_is_used(packages: Packages, tmp_path: Path) -> None:
    module = FILE.format(name="notes").partition("@register_executor")[0] + "kind = ExecutorKind(Noting, (PLACE,))\n"
    module = module.replace("register_executor", "ExecutorKind")
    packages.add("noters", {"executors": {"notes": "noters:kind"}}, noters=module)
    assert "notes" in EXECUTORS.names()
    request = ExecutorRequest("notes", options={"notes-place": str(tmp_path / "n")})
    executor = make_executor(Store(tmp_path / "cache"), request)
    executor.close()
    assert (executor.name, executor.capacity) == ("notes", 1)
    assert executor_size(request).workers >= 1
    assert chosen(request)[0] is EXECUTORS.get("notes")


def test_executors_that_cannot_be_used_affect_no_other(
    toy: Toy, notes: Path, packages: Packages, pano_mvs: Command
) -> None:
    packages.add("dark", {"executors": {"dark": "dark:kind", "odd": "json:dumps"}}, dark="1 / 0\n")
    (notes / "same.py").write_text(FILE.format(name="notes").replace("def noting", "def again"))
    (notes / "bad.py").write_text("LIMIT = {}[3]\n")
    arguments = ("run", toy.folder / "wf.yaml", "--executor")
    assert pano_mvs(*arguments, "serial").code == 0
    for name, reason in (
        ("dark", "ZeroDivisionError: division by zero"),
        ("odd", "json:dumps is not an executor"),
        ("notes", "'notes' is defined twice"),
        ("bad", "bad.py failed to load"),
    ):
        result = pano_mvs(*arguments, name)
        assert result.code == 2
        assert reason in result.flat
    assert "notes-place" not in executor_options()


@pytest.mark.parametrize("error", ["ValueError('no cluster')", "UsageError('no cluster')"])
def test_an_executor_that_cannot_start_says_why(
    toy: Toy, notes: Path, pano_mvs: Command, error: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = FILE.format(name="notes").replace("return Noting(store, request)", f"raise {error}")
    (notes / "notes.py").write_text(f"from pano_mvs.api import UsageError\n{text}")
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "notes")
    assert result.code == 2
    assert "no cluster" in result.flat
    assert "internal error" not in result.flat


def test_an_object_that_is_no_executor_is_named(toy: Toy, notes: Path, pano_mvs: Command) -> None:
    text = FILE.format(name="notes").replace("return Noting(store, request)", "return object()")
    (notes / "notes.py").write_text(text)
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "notes")
    assert result.code == 2
    assert "makes an object of object, which has no name, capacity, threads" in result.flat


def test_an_unknown_executor_lists_the_known_ones(notes: Path, tmp_path: Path, pano_mvs: Command) -> None:
    pano_mvs("--help")
    with pytest.raises(UsageError, match=r"there is no executor 'note'; did you mean 'notes'\? known: serial, proc"):
        make_executor(Store(tmp_path), ExecutorRequest("note"))
    with pytest.raises(PluginError, match="'serial' is built in"):
        EXECUTORS.register("serial", EXECUTORS.get("processes"), tmp_path.exists)
