"""Workflow files: what is read, inherited and changed for a run, and which mistakes are reported."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError, PluginError, UsageError, WorkflowError
from pano_mvs.core.yaml_text import parse_yaml
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.policy import RESERVED_KEYS
from pano_mvs.engine.workflows.wiring import wire
from pano_mvs.engine.workflows.workflow import Workflow, WorkflowReader, find_workflow, load_workflow
from pano_mvs.scene import RangeMap
from pano_mvs.session.session import open_session, presets_folder
from tests.engine.conftest import Toy, ran
from tests.presets import usable_presets


def problems(toy: Toy, text: str) -> list[str]:
    """Return the mistakes that are found in a workflow."""
    (toy.folder / "wf.yaml").write_text(textwrap.dedent(text))
    with pytest.raises(WorkflowError) as caught:
        toy.session()
    return [problem.replace(str(toy.folder / "wf.yaml"), "wf.yaml") for problem in caught.value.problems]


HEAD = "pano_mvs: 1\nplugins: [plug.py]\nstages:\n"


def test_every_mistake_is_found_in_one_go_with_its_place(toy: Toy) -> None:
    found = problems(
        toy,
        HEAD + "  images: {use: toy.source, path: capture, colour: 1}\n"
        "  scaled: {use: toy.scael}\n"
        "  other:  {use: toy.scale, by: many, on_errror: skip, retries: -1}\n",
    )
    assert "wf.yaml:4:44: stage 'images': unknown setting 'colour'." in found[0]
    assert found[1].startswith("wf.yaml:5:17: stage 'scaled': there is no stage 'toy.scael'; did you mean 'toy.scale'")
    assert any(line.startswith("wf.yaml:6:32: stage 'other': by:") for line in found)
    assert any("wf.yaml:6:38: stage 'other': unknown setting 'on_errror'. Did you mean 'on_error'?" in p for p in found)
    assert any("stage 'other': retries:" in line for line in found)


def test_a_stage_without_a_library_that_it_needs_is_refused_before_anything_runs(toy: Toy) -> None:
    """A textured mesh failed in the last stage, after seven minutes."""
    needs = '@stage("toy.scale", needs={"no_such_module": "no-such-package", "numpy": "numpy"})'
    toy.edit("plug.py", lambda text: text.replace('@stage("toy.scale")', needs))
    with pytest.raises(WorkflowError, match=r"toy\.scale needs .* not installed: pip install no-such-package"):
        toy.session()


def test_an_optional_stage_that_no_plugin_offers_is_left_out_and_named(toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text + "  extra: {use: toy.nobody, optional: true, by: 3}\n")
    session = toy.session()
    assert "extra" not in session.workflow.stages
    (reason,) = session.workflow.warnings
    assert reason.startswith("stage 'extra' is left out, because it is optional and no plugin offers toy.nobody")
    toy.edit("wf.yaml", lambda text: text.replace("toy.nobody, optional: true", "toy.nobody, optional: false"))
    with pytest.raises(WorkflowError, match=r"stage 'extra': there is no stage 'toy\.nobody'"):
        toy.session()


def test_the_models_of_presets_need_no_ranges() -> None:
    """`--until colmap` computed everything before masks.moving, 262 s in place of 40."""
    registry = Registry.installed()
    for preset in usable_presets():
        workflow = load_workflow(preset, registry, presets=presets_folder())
        if "colmap" not in workflow.stages or workflow.stages["colmap"].spec.name != "export.colmap":
            continue
        made = {workflow.stages[name].spec.output for name in wire(workflow).limited_to({"colmap"}, {}).order}
        assert RangeMap not in made, preset


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("import no_such_module", r"plug.py:1: ModuleNotFoundError"),
        ("def f(:\n", r"plug.py:1: "),
        ("x = 1\n", "defines no stage"),
        ("\n\nfrom pano_mvs.api import *\n@stage('a.b')\ndef f(x: int) -> Pairs: ...\n", r"plug.py:4.*argument 'x'"),
        ("from pano_mvs.api import *\n@stage('a.b')\ndef f(x: Each[Panorama]): ...\n", "the result must be annotated"),
    ],
)
def test_a_plugin_that_fails_to_import_says_where(toy: Toy, code: str, what: str) -> None:
    (toy.folder / "plug.py").write_text(code)
    with pytest.raises(WorkflowError, match=what) as caught:
        toy.session()
    assert "wf.yaml:3:11" in str(caught.value)


def test_stage_names_belong_to_one_place(toy: Toy) -> None:
    registry = Registry()
    registry.add_file(toy.folder / "plug.py")
    (toy.folder / "copy.py").write_text((toy.folder / "plug.py").read_text())
    with pytest.raises(PluginError, match=r"defined twice: .*plug\.py.* and .*copy\.py"):
        registry.add_file(toy.folder / "copy.py")


def test_built_in_stages_come_through_the_entry_point() -> None:
    registry = Registry.installed()
    assert {"source.folder", "depth.sweep", "export.colmap"} <= set(registry.stages)
    assert registry.broken == []


def test_workflow_that_is_not_there_suggests_a_preset(tmp_path: Path) -> None:
    (tmp_path / "quickstart.yaml").write_text("")
    with pytest.raises(UsageError, match="Did you mean 'quickstart'"):
        find_workflow("quikstart", tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        load_workflow(tmp_path / "gone.yaml", Registry())


def test_yaml_is_version_1_2() -> None:
    assert parse_yaml("[yes, no, on, 0o17, 0x1F, 1e3, ~, true, 012, 1:30]", "t").plain() == [
        "yes",
        "no",
        "on",
        15,
        31,
        1000.0,
        None,
        True,
        12,
        "1:30",
    ]


def test_paths_that_do_not_exist_are_found_before_anything_runs(toy: Toy) -> None:
    found = problems(toy, HEAD + "  i: {use: toy.source, path: gone}\n")
    assert found == [f"wf.yaml:4:30: stage 'i': path: {toy.folder / 'gone'} does not exist"]


def test_paths_from_the_command_line_are_relative_to_the_current_folder(
    toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "mine").mkdir(parents=True)
    monkeypatch.chdir(elsewhere)
    params = toy.session("images.path=mine").workflow.stages["images"].params.model_dump()
    assert params["path"] == elsewhere / "mine"


def test_mistakes_on_the_command_line_are_not_blamed_on_the_file(toy: Toy) -> None:
    with pytest.raises(WorkflowError) as caught:
        toy.session("scaled.by=many")
    assert caught.value.problems[0].startswith("--set scaled.by: stage 'scaled': by:")


CHILD = "pano_mvs: 1\nname: child\nextends: wf.yaml\n"


def load(toy: Toy, text: str, *overrides: str) -> Workflow:
    """Return a workflow that is written beside the toy's."""
    (toy.folder / "child.yaml").write_text(text)
    return load_workflow(toy.folder / "child.yaml", Registry(), overrides=overrides, presets=presets_folder())


def problems_of_child(toy: Toy, text: str) -> list[str]:
    with pytest.raises(WorkflowError) as caught:
        load(toy, text)
    return [line.replace(f"{toy.folder}/", "") for line in caught.value.problems]


def test_nothing_said_is_the_same_workflow(toy: Toy) -> None:
    below = toy.session().workflow
    child = load(toy, CHILD)
    assert list(child.stages) == list(below.stages)
    for name, entry in child.stages.items():
        assert entry.params.model_dump() == below.stages[name].params.model_dump()
        assert entry.policy == below.stages[name].policy
    assert child.name == "child"
    assert "extended: " in child.text
    assert load(toy, CHILD.replace("name: child\n", "")).name == "child", "by its own file, not by what it extends"


def test_a_stage_given_again_is_overridden_setting_by_setting(toy: Toy) -> None:
    child = load(toy, CHILD + "stages:\n  mean: {retries: 2, in: {around: images, own: images}}\n  scaled: {by: 5}\n")
    assert child.stages["scaled"].params.model_dump() == {"by": 5.0}
    assert child.stages["mean"].policy.inputs == {"around": "images", "own": "images"}
    assert child.stages["mean"].policy.retries == 2
    assert list(child.stages) == list(toy.session().workflow.stages), "the order stays"


def test_another_use_replaces_all_of_it_and_the_same_use_nothing(toy: Toy) -> None:
    same = load(toy, CHILD + "stages: {scaled: {use: toy.scale, retries: 1}}")
    assert same.stages["scaled"].params.model_dump() == {"by": 3.0}
    other = load(toy, CHILD + "stages: {difference: {use: toy.scale}}")
    assert other.stages["difference"].policy.inputs == {}


def test_null_removes_a_stage_and_undoes_a_reserved_key(toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 3, retries: 4, to: x, gate: {value: 1}"))
    child = load(toy, CHILD + "stages: {each: null, views: , mean: , scaled: {retries: null, to: ~, gate: null}}")
    assert not {"each", "views", "mean"} & set(child.stages)
    policy = child.stages["scaled"].policy
    assert (policy.retries, policy.to, policy.gate) == (0, "", {})


def test_new_stages_stand_where_they_are_written(toy: Toy) -> None:
    behind = load(toy, CHILD + "stages: {scaled: {}, a: {use: toy.scale}, b: {use: toy.scale}, views: {}}")
    assert list(behind.stages)[:5] == ["images", "scaled", "a", "b", "pairs"]
    before = load(toy, CHILD + "stages: {a: {use: toy.scale}, pairs: {}}")
    assert list(before.stages)[1:4] == ["scaled", "a", "pairs"]
    assert list(load(toy, CHILD + "stages: {a: {use: toy.scale}}").stages)[-1] == "a"


def test_later_files_hold_and_each_is_read_once(toy: Toy) -> None:
    (toy.folder / "five.yaml").write_text("pano_mvs: 1\nextends: wf.yaml\nstages: {scaled: {by: 5}}\n")
    (toy.folder / "more.yaml").write_text("pano_mvs: 1\nextends: wf.yaml\nstages: {scaled: {retries: 6}}\n")
    child = load(toy, CHILD.replace("wf.yaml", "[five.yaml, more.yaml]"))
    assert child.stages["scaled"].params.model_dump() == {"by": 5.0}, "wf.yaml below both is not laid over five.yaml"
    assert child.stages["scaled"].policy.retries == 6


def test_a_list_may_hold_parts_that_are_no_workflows_by_themselves(toy: Toy) -> None:
    (toy.folder / "part.yaml").write_text("pano_mvs: 1\nstages: {scaled: {by: 7}, each: null}\n")
    child = load(toy, CHILD.replace("wf.yaml", "[wf.yaml, part.yaml]"))
    assert child.stages["scaled"].params.model_dump() == {"by": 7.0}
    assert "each" not in child.stages


def test_paths_are_relative_to_the_file_that_states_them(toy: Toy) -> None:
    inner = toy.folder / "inner"
    (inner / "mine").mkdir(parents=True)
    (inner / "deep.yaml").write_text("pano_mvs: 1\nextends: ../wf.yaml\n")
    (inner / "own.yaml").write_text("pano_mvs: 1\nextends: ../wf.yaml\nstages: {images: {path: mine}}\n")
    deep = load_workflow(inner / "deep.yaml", Registry())
    assert deep.stages["images"].params.model_dump()["path"].resolve() == toy.folder / "capture"
    assert [path.resolve() for path in deep.plugins] == [toy.folder / "plug.py"]
    own = load_workflow(inner / "own.yaml", Registry())
    assert own.stages["images"].params.model_dump()["path"] == inner / "mine"


def test_the_cache_does_not_know_of_files(finished: Toy) -> None:
    (finished.folder / "inner").mkdir()
    (finished.folder / "inner" / "wf.yaml").write_text("pano_mvs: 1\nname: toy\nextends: ../wf.yaml\n")
    plain = finished.folder
    finished.folder = plain / "inner"
    assert ran(finished.run(cache=plain / "cache")) == {}
    (finished.folder / "wf.yaml").write_text(
        "pano_mvs: 1\nname: toy\nextends: ../wf.yaml\nstages: {mean: {retries: 3}}\n"
    )
    assert ran(finished.run(cache=plain / "cache")) == {}, "what happens on errors does not count"


def test_presets_may_be_extended_by_name(toy: Toy) -> None:
    with pytest.raises(WorkflowError, match=r"no preset 'quickstrat'\. Did you mean 'quickstart'"):
        load(toy, "pano_mvs: 1\nextends: quickstrat\n")
    (toy.folder / "mine.yaml").write_text("pano_mvs: 1\nextends: quickstart\nstages: {depth: {planes: 64}}\n")
    session = open_session(str(toy.folder / "mine.yaml"))
    assert session.workflow.stages["depth"].params.model_dump()["planes"] == 64
    assert session.workflow.name == "mine"
    assert str(presets_folder()) in str(session.workflow.stages["images"].params.model_dump()["path"])


def test_circles_are_told_with_the_chain(toy: Toy) -> None:
    (toy.folder / "a.yaml").write_text("pano_mvs: 1\nextends: b.yaml\n")
    (toy.folder / "b.yaml").write_text("pano_mvs: 1\nextends: child.yaml\n")
    found = problems_of_child(toy, CHILD.replace("wf.yaml", "a.yaml"))
    assert (
        "b.yaml:2:10: extends: the files extend each other in a circle: child.yaml → a.yaml → b.yaml → child.yaml"
        in found
    )
    itself = problems_of_child(toy, CHILD.replace("wf.yaml", "child.yaml"))
    assert any("circle: child.yaml → child.yaml" in line for line in itself)


def test_mistakes_are_told_with_the_place_in_their_own_file(toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("by: 3", "by: many"))
    found = problems_of_child(toy, CHILD + "stages:\n  pairs: {colour: 1}\n  none: {by: 1}\n  away: null\n  nine: 9\n")
    assert any(line.startswith("wf.yaml:6:36: stage 'scaled': by:") for line in found), found
    assert any(line.startswith("child.yaml:5:11: stage 'pairs': unknown setting 'colour'") for line in found), found
    assert any("child.yaml:6:3: stage 'none' needs `use: NAME`; no file that is extended has" in line for line in found)
    assert any(
        "child.yaml:7:3: stage 'away' needs `use: NAME`; there is no stage of that name to remove" in p for p in found
    )
    assert any(line.startswith("child.yaml:8:3: stage 'nine' needs `use: NAME`: write") for line in found)


@pytest.mark.parametrize(
    ("extends", "what"),
    [
        ("7", "child.yaml:3:10: extends: must be a workflow file or a preset"),
        ("{a: b}", "child.yaml:3:10: extends: must be a workflow file or a preset"),
        ("[wf.yaml, 7]", "child.yaml:3:20: extends: must be a workflow file or a preset"),
        ("''", "extends: must be a workflow file or a preset"),
        ("wf.yml", "child.yaml:3:10: extends: there is no file wf.yml and no preset 'wf.yml'. Did you mean 'wf.yaml'"),
        ("../../../no/such", "child.yaml:3:10: extends: there is no file"),
        ("capture", "child.yaml:3:10: extends: workflow capture is a folder"),
        ("plug.py", "plug.py:"),
    ],
)
def test_what_cannot_be_extended(toy: Toy, extends: str, what: str) -> None:
    found = problems_of_child(toy, CHILD.replace("wf.yaml", extends))
    assert any(what in line for line in found), found


def test_files_that_extend_two_others_each_do_not_multiply(toy: Toy) -> None:
    """Twenty levels of two files that extend both of the level below are forty files, not a million readings."""
    for level in range(20):
        below = f"[a{level - 1}.yaml, b{level - 1}.yaml]" if level else "wf.yaml"
        for name in "ab":
            (toy.folder / f"{name}{level}.yaml").write_text(f"pano_mvs: 1\nextends: {below}\n")
    assert "scaled" in load(toy, CHILD.replace("wf.yaml", "a19.yaml")).stages
    for number in range(60):
        (toy.folder / f"c{number}.yaml").write_text(f"pano_mvs: 1\nextends: c{number + 1}.yaml\n")
    assert "at most 50 files are allowed" in problems_of_child(toy, CHILD.replace("wf.yaml", "c0.yaml"))[-1]


SETTINGS = '''
from pano_mvs.api import InputPath, Names, One, Pairs, Params, SourcePath, stage
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
    files: SourcePath | list[SourcePath] = []


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


def load_with(folder: Path, *overrides: str, images: Path | None = None) -> Workflow:
    return WorkflowReader("wf.yaml", folder, Registry()).read(TEXT, overrides=overrides, images=images)


def problems_with(folder: Path, *overrides: str) -> list[str]:
    with pytest.raises(WorkflowError) as caught:
        load_with(folder, *overrides)
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
    assert load_with(settings, override).stages["many"].params.model_dump()[key] == value


@pytest.mark.parametrize(
    "name", ["a #1", "20241128", "1.5", "1e3", "null", "[a", "{x}", "a: b", "'a'", "- a", "true", "!x"]
)
def test_a_path_takes_the_text_as_it_stands(settings: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folder `a` was used for `a #1`, and folders that YAML takes for a number or null failed or vanished."""
    monkeypatch.chdir(settings)
    (settings / name).mkdir()
    found = load_with(settings, f"many.file={name}", f"many.files={name}" if name != "[a" else "many.numbers=[1]")
    params = found.stages["many"].params.model_dump()
    assert params["file"] == settings / name
    assert name == "[a" or params["files"] == settings / name
    (settings / f"{name}.py").write_text(SETTINGS.replace("test.", "extra."))
    if not name.startswith("["):
        assert [path.name for path in load_with(settings, f"plugins={name}.py").plugins][1:] == [f"{name}.py"]


def test_paths_can_be_unset_and_listed(settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(settings)
    for name in ("a", "b"):
        (settings / name).mkdir()
    found = load_with(settings, "many.file=a", "many.file=", "many.files=[a, b]", "many.files.1 =  a")
    params = found.stages["many"].params.model_dump()
    assert (params["file"], params["files"]) == (None, [settings / "a", settings / "a"])
    text = TEXT.replace("retries: 3", "file: 20241128")
    with pytest.raises(
        WorkflowError,
        match=r"wf\.yaml:4:\d+: stage 'many': file: YAML reads this as .*put the name of a file in quotes",
    ):
        WorkflowReader("wf.yaml", settings, Registry()).read(text)


def test_names_with_dots_later_ones_and_reserved_keys(settings: Path) -> None:
    found = load_with(
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
    found = load_with(settings, "many.limit=8", "many.use=test.many").stages["many"]
    assert found.params.model_dump()["numbers"] == [4, 5], "the same use changes nothing"
    few = load_with(settings, "many.retries=1", "many.use=test.few").stages["many"]
    assert (few.spec.name, few.policy.retries) == ("test.few", 1)


def test_a_stage_can_be_removed(settings: Path) -> None:
    assert list(load_with(settings, "many.more=null").stages) == ["many"]
    assert "no stage is left" in problems_with(settings, "many=null", "many.more=~")[0]


def test_plugin_files_can_be_added(toy: Toy, settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = toy.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "extra.py").write_text(SETTINGS.replace("test.", "extra."))
    monkeypatch.chdir(elsewhere)
    for value in ("extra.py", "[extra.py]"):
        found = load_with(settings, f"plugins={value}", "many.use=extra.few")
        assert found.stages["many"].spec.name == "extra.few"
        assert [path.name for path in found.plugins] == ["settings.py", "extra.py"]
    gone = problems_with(settings, "plugins=gone.py")
    assert gone[0].startswith("--set plugins: plugin file")
    assert "--set plugins: a plugin must be the path of a Python file" in problems_with(settings, "plugins=[7]")


def test_paths_in_files_and_on_the_command_line(
    settings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "a.txt").touch()
    monkeypatch.chdir(tmp_path / "here")
    assert (
        load_with(settings, "many.file=a.txt").stages["many"].params.model_dump()["file"] == tmp_path / "here" / "a.txt"
    )


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
        ("use=null", "no stage 'use'"),
        (".use=x", "no stage ''"),
        ("many.use=null", "--set many.use: stage 'many': there is no stage None"),
        ("many.gate.x={min: 2, max: 1}", "min 2 is larger than max 1: nothing would pass"),
        ("many.gate.x={}", "give {min: …}, {max: …} or both"),
        ("many.gate.x=high", "must be a number (the minimum) or {min: …, max: …}"),
        ("many.gate.x.mim=1", "unknown setting 'gate.x.mim'."),
        ("many.to=../up", "--set many.to: stage 'many': to: must be a folder inside the output folder"),
        ("many.memory=lots", "memory: must be a size such as 500MB"),
        ("many.limit=1,2", '(got "1,2"). `pano-mvs vary --set many.limit=1,2` runs with each of these values'),
        pytest.param(f"many.memory={'9' * 400}GB", "memory: must be at most 9223372.0 TB", id="many.memory=999…GB"),
        ("many.file=gone.txt", "gone.txt does not exist"),
    ],
)
def test_what_cannot_be_set_is_told_with_the_option(settings: Path, override: str, what: str) -> None:
    found = problems_with(settings, override)
    assert any(what in line for line in found), found
    assert all(line.startswith("--set ") for line in found)


@pytest.mark.parametrize(
    "override", ["many.limits=1,2", "many.limit=1,x", "many.numbers=1,2", "many.limit=[1,2]", "many.limit=1e400,2"]
)
def test_vary_is_not_named_where_it_would_refuse_a_value(settings: Path, override: str) -> None:
    """A misspelt setting, and values that are wrong by themselves, were said to run with it."""
    found = problems_with(settings, override)
    assert found
    assert not any("vary" in line for line in found), found


def test_the_command_that_takes_several_values_can_be_copied(settings: Path) -> None:
    (found,) = problems_with(settings, "many.limit=1, 2")
    assert "`pano-mvs vary --set 'many.limit=1, 2'` runs" in found


REFERENCE = Path(__file__).parents[3] / "docs" / "workflows.md"


@pytest.mark.parametrize(
    ("gate", "requires"),
    [
        ("{value: 31}", "value is 30, but `gate` requires 31 or more"),
        ("{value: {min: 30.5}}", "value is 30, but `gate` requires 30.5 or more"),
        ("{value: {max: 29}}", "value is 30, but `gate` requires 29 or less"),
        ("{value: {min: 1, max: 29}}", "29 or less"),
        ("{value: 30}", ""),
        ("{value: {min: 30, max: 30}}", ""),
        ("{value: {max: 1e9}}", ""),
        ("{}", ""),
    ],
)
def test_thresholds_have_a_minimum_and_a_maximum(toy: Toy, gate: str, requires: str) -> None:
    result = toy.run(f"scaled.gate={gate}")
    assert result.exit_code == (4 if requires else 0)
    assert requires in result.stopped
    assert ("mean" in ran(result)) != bool(requires), "what reads from the stage waits until it has passed"


def test_a_gate_that_is_changed_computes_nothing_again(finished: Toy) -> None:
    assert ran(finished.run("scaled.gate={value: {max: 99}}", "scaled.retries=2", "scaled.timeout_s=100")) == {}
    assert finished.run("scaled.gate={value: {max: 9}}").exit_code == 4, "a cached stage is held to it too"


@pytest.mark.parametrize(("share", "code"), [(0.8, 3), (0.81, 4)])
def test_the_share_that_must_succeed(toy: Toy, share: float, code: int) -> None:
    toy.number("3.txt", "13")
    result = toy.run(f"scaled.min_success={share}")
    assert result.exit_code == code
    assert ("4 of 5 units succeeded, min_success is 0.81" in result.stopped) == (code == 4)


def test_what_could_not_run_counts_as_not_done(toy: Toy) -> None:
    toy.number("3.txt", "13")
    assert "stage 'mean': 4 of 5 units succeeded" in toy.run("mean.min_success=0.9").stopped


def test_a_source_stops_at_an_image_that_cannot_be_used(toy: Toy) -> None:
    toy.edit(
        "plug.py", lambda text: text.replace('{"text": path})', '{"text": path}, "no good" * (path.name == "3.txt"))')
    )
    assert toy.run().exit_code == 3
    result = toy.run("images.on_error=stop")
    assert result.exit_code == 4
    assert result.stopped == "stage 'images' has on_error: stop, and 3.txt cannot be used: no good"


@pytest.mark.parametrize(("retries", "code"), [(0, 3), (1, 3), (2, 0)])
def test_a_unit_is_tried_again_so_often(toy: Toy, retries: int, code: int) -> None:
    count = toy.folder / "count"
    count.touch()
    failing = f"""
    from pathlib import Path
    count = Path({str(count)!r})
    if x.value == 30:
        count.write_text(count.read_text() + "x")
    if x.value == 30 and len(count.read_text()) < 3:"""
    toy.edit("plug.py", lambda text: text.replace("    if x.value == 13:", failing))
    assert toy.run(f"scaled.retries={retries}").exit_code == code
    assert len(count.read_text()) == retries + 1


PAGE = REFERENCE.read_text(encoding="utf-8")
EXAMPLES = re.findall(r"(?<!<!-- group -->\n)```yaml\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("text", EXAMPLES, ids=range(len(EXAMPLES)))
def test_the_examples_of_the_reference_are_sound(text: str, tmp_path: Path) -> None:
    for name, group in re.findall(r"Save this as `([^`]+)`:\n\n<!-- group -->\n```yaml\n(.*?)```", PAGE, re.DOTALL):
        (tmp_path / name).write_text(group)
    graph = wire(WorkflowReader("t", tmp_path, Registry.installed(), presets=presets_folder()).read(text))
    order = list(graph.order)
    if "levelled" in order:
        assert order.index("levelled") == order.index("refined") + 1


def test_the_reference_names_every_reserved_key() -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    assert len(EXAMPLES) >= 4
    assert [key for key in RESERVED_KEYS if f"`{key}`" not in text] == []
