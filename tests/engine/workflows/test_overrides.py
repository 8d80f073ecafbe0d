"""What `--set` can change, and what it says when it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.errors import WorkflowError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.workflow import Workflow, WorkflowReader
from tests.engine.conftest import Toy

SETTINGS = '''
from pano_mvs.api import InputPath, Names, One, Pairs, Params, stage
from pydantic import Field


class Inner(Params):
    x: float = 0
    names: list[str] = []


class Many(Params):
    numbers: list[int] = [1, 2]
    table: dict[str, float] = {}
    inner: Inner = Inner()
    limit: float | None = 3
    file: InputPath | None = None


@stage("test.many")
def many(params: Many) -> Pairs:
    """Many kinds of settings."""
    return Pairs(())


@stage("test.few")
def few() -> Pairs:
    """None."""
    return Pairs(())
'''
TEXT = """\
pano_mvs: 1
plugins: [settings.py]
stages:
  many: {use: test.many, numbers: [4, 5], inner: {x: 2}, retries: 3}
  many.more: {use: test.many}
"""


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    (tmp_path / "settings.py").write_text(SETTINGS)
    return tmp_path


def load(folder: Path, *overrides: str, images: Path | None = None) -> Workflow:
    return WorkflowReader("wf.yaml", folder, Registry()).read(TEXT, overrides=overrides, images=images)


def problems(folder: Path, *overrides: str) -> list[str]:
    with pytest.raises(WorkflowError) as caught:
        load(folder, *overrides)
    return caught.value.problems


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("many.numbers=[7, 8, 9]", "numbers", [7, 8, 9]),
        ("many.numbers=[]", "numbers", []),
        ("many.numbers.0=7", "numbers", [7, 5]),
        ("many.numbers.2=7", "numbers", [4, 5, 7]),
        ("many.table={a: 1, b: 2}", "table", {"a": 1.0, "b": 2.0}),
        ("many.table.a=1", "table", {"a": 1.0}),
        ("many.inner.x=9", "inner", {"x": 9.0, "names": []}),
        ("many.inner.names=[a b, c]", "inner", {"x": 2.0, "names": ["a b", "c"]}),
        ("many.inner={}", "inner", {"x": 0.0, "names": []}),
        ("many.limit=null", "limit", None),
        ("many.limit=", "limit", None),
        ("many.limit=1e-3", "limit", 0.001),
        (" many.limit = 4 ", "limit", 4.0),
    ],
)
def test_values_of_every_form(settings: Path, override: str, key: str, value: object) -> None:
    assert load(settings, override).stages["many"].params.model_dump()[key] == value


def test_names_with_dots_later_ones_and_reserved_keys(settings: Path) -> None:
    found = load(
        settings,
        "many.more.limit=1",
        "many.more.limit=2",
        "many.retries=null",
        "many.gate.points={max: 3}",
        "many.to=draft",
        "many.on_error=stop",
        "many.min_success=0.5",
        "many.timeout_s=9",
        "many.memory=2GB",
    ).stages
    assert found["many.more"].params.model_dump()["limit"] == 2
    policy = found["many"].policy
    assert (policy.retries, policy.to, policy.on_error, policy.min_success) == (0, "draft", "stop", 0.5)
    assert (policy.timeout_s, policy.memory_bytes) == (9, 2_000_000_000)
    assert policy.gate["points"].max == 3


def test_another_use_starts_from_nothing_whatever_the_order(settings: Path) -> None:
    found = load(settings, "many.limit=8", "many.use=test.many").stages["many"]
    assert found.params.model_dump()["numbers"] == [4, 5], "the same use changes nothing"
    few = load(settings, "many.retries=1", "many.use=test.few").stages["many"]
    assert (few.spec.name, few.policy.retries) == ("test.few", 1)


def test_a_stage_can_be_removed(settings: Path) -> None:
    assert list(load(settings, "many.more=null").stages) == ["many"]
    assert "no stage is left" in problems(settings, "many=null", "many.more=~")[0]


def test_plugin_files_can_be_added(toy: Toy, settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = toy.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "extra.py").write_text(SETTINGS.replace("test.", "extra."))
    monkeypatch.chdir(elsewhere)
    for value in ("extra.py", "[extra.py]"):
        found = load(settings, f"plugins={value}", "many.use=extra.few")
        assert found.stages["many"].spec.name == "extra.few"
        assert [path.name for path in found.plugins] == ["settings.py", "extra.py"]
    gone = problems(settings, "plugins=gone.py")
    assert gone[0].startswith("--set plugins: plugin file")
    assert "--set plugins: a plugin must be the path of a Python file" in problems(settings, "plugins=7")


def test_paths_in_files_and_on_the_command_line(
    settings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "a.txt").touch()
    monkeypatch.chdir(tmp_path / "here")
    assert load(settings, "many.file=a.txt").stages["many"].params.model_dump()["file"] == tmp_path / "here" / "a.txt"


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("many", "--set many: write STAGE.PARAM=VALUE, such as depth.planes=192"),
        ("=1", "--set =1: write STAGE.PARAM=VALUE"),
        ("many=1", "--set many=1: write STAGE.PARAM=VALUE"),
        ("many.more=1", "many.more=null removes the stage"),
        ("many.=1", "--set many.=1: write STAGE.PARAM=VALUE"),
        ("many..limit=1", "write STAGE.PARAM=VALUE"),
        ("mani.limit=1", "--set mani.limit=1: no stage 'mani'. Did you mean 'many'"),
        ("many.limits=1", "--set many.limits: stage 'many': unknown setting 'limits'. Did you mean 'limit'?"),
        ("many.retires=1", "unknown setting 'retires'. Did you mean 'retries'?"),
        ("many.numbers.7=1", "--set many.numbers.7=1: numbers is a list of 2: give a position from 0"),
        ("many.numbers.x=1", "numbers is a list of 2: give a position from 0"),
        ("many.numbers.-1=1", "numbers is a list of 2: give a position from 0"),
        ("many.numbers.99999999999999999999=1", "numbers is a list of 2"),
        ("many.retries.x=1", "--set many.retries.x=1: retries is 3, which has no 'x'"),
        ("many.inner.y=1", "--set many.inner.y: stage 'many': unknown setting 'inner.y'."),
        ("many.limit=many", "--set many.limit: stage 'many': limit:"),
        ("many.limit=[", "--set many.limit:1:"),
        ("many.limit=1e400", "--set many.limit:1:1: '1e400' is not a finite number"),
        ("many.limit=!!python/name:os.system", "is not allowed; write a plain value"),
        ("many.use=test.man", "--set many.use: stage 'many': there is no stage 'test.man'; did you mean 'test.many'"),
        ("many.use=[1]", "--set many.use: stage 'many': there is no stage [1]"),
        ("many.use=null", "--set many.use: stage 'many': there is no stage None"),
        ("many.gate.x={min: 2, max: 1}", "min 2 is larger than max 1: nothing would pass"),
        ("many.gate.x={}", "give {min: …}, {max: …} or both"),
        ("many.gate.x=high", "must be a number (the minimum) or {min: …, max: …}"),
        ("many.gate.x.mim=1", "unknown setting 'gate.x.mim'."),
        ("many.to=../up", "--set many.to: stage 'many': to: must be a folder inside the output folder"),
        ("many.memory=lots", "memory: must be a size such as 500MB"),
        ("many.file=gone.txt", "gone.txt does not exist"),
    ],
)
def test_what_cannot_be_set_is_told_with_the_option(settings: Path, override: str, what: str) -> None:
    found = problems(settings, override)
    assert any(what in line for line in found), found
    assert all(line.startswith("--set ") for line in found)
