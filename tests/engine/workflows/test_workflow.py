from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError, PluginError, UsageError, WorkflowError
from pano_mvs.core.yaml_text import parse_yaml
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.wiring import wire
from pano_mvs.engine.workflows.workflow import find_workflow, load_workflow
from pano_mvs.scene import RangeMap
from pano_mvs.session.session import presets_folder
from tests.engine.conftest import Toy


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


def test_the_models_of_presets_need_no_ranges() -> None:
    """`--until colmap` computed everything before masks.moving, 262 s in place of 40."""
    registry = Registry.installed()
    for preset in presets_folder().glob("*.yaml"):
        workflow = load_workflow(preset, registry, presets=presets_folder())
        if "colmap" not in workflow.stages or workflow.stages["colmap"].spec.name != "export.colmap":
            continue
        made = {workflow.stages[name].spec.output for name in wire(workflow).limited_to({"colmap"}, {}).order}
        assert RangeMap not in made, preset


@pytest.mark.parametrize(
    ("text", "place", "what"),
    [
        ("pano_mvs: 1\npano_mvs: 1\nstages: {}", "wf.yaml:2:1", "occurs twice"),
        ("pano_mvs: 1\nstagse: {}", "wf.yaml:2:1", "unknown key 'stagse'. Did you mean 'stages'?"),
        ("stages: {a: {use: x}}", "wf.yaml:1:1", "`pano_mvs: 1` is missing"),
        ("pano_mvs: 7\nstages: {a: {use: x}}", "wf.yaml:1:11", "workflow format 7"),
        ("pano_mvs: 1\nstages: [a]", "wf.yaml:2:9", "must be a mapping"),
        ("pano_mvs: 1\nstages: {a: {path: capture}}", "wf.yaml:2:10", "needs `use: NAME`"),
        ("pano_mvs: 1\nstages: {../a: {use: x}}", "wf.yaml:2:10", "must consist"),
        ("pano_mvs: !!python/object:os.system 1", "wf.yaml:1:11", "is not allowed"),
        ("pano_mvs: [1", "wf.yaml", "expected"),
        ("", "wf.yaml:1:1", "empty"),
        ("pano_mvs: 1\nname: a/b\nstages: {a: {use: x}}", "wf.yaml:2:7", "name must consist"),
        ("pano_mvs: 1\nplugins: plug.py\nstages: {a: {use: x}}", "wf.yaml:2:10", "must be a list"),
        ("pano_mvs: 1\nplugins: [gone.py]\nstages: {a: {use: x}}", "wf.yaml:2:11", "does not exist"),
        ("[" * 10_000, "wf.yaml", "nested too deeply"),
        ("pano_mvs: " + "9" * 10_000, "wf.yaml:1:11", "not a usable number"),
    ],
)
def test_mistakes_of_form(toy: Toy, text: str, place: str, what: str) -> None:
    found = problems(toy, text)
    assert any(line.startswith(place) and what in line for line in found), found


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
