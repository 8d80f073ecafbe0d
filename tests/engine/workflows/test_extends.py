"""`extends:`: files laid over each other, each mistake told with the place in its own file."""

from __future__ import annotations

import pytest

from pano_mvs.core.errors import WorkflowError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.workflow import Workflow, load_workflow
from pano_mvs.session.session import open_session, presets_folder
from tests.engine.conftest import Toy, ran

CHILD = "pano_mvs: 1\nname: child\nextends: wf.yaml\n"


def load(toy: Toy, text: str, *overrides: str) -> Workflow:
    """Return a workflow that is written beside the toy's."""
    (toy.folder / "child.yaml").write_text(text)
    return load_workflow(toy.folder / "child.yaml", Registry(), overrides=overrides, presets=presets_folder())


def problems(toy: Toy, text: str) -> list[str]:
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
    found = problems(toy, CHILD.replace("wf.yaml", "a.yaml"))
    assert (
        "b.yaml:2:10: extends: the files extend each other in a circle: child.yaml → a.yaml → b.yaml → child.yaml"
        in found
    )
    itself = problems(toy, CHILD.replace("wf.yaml", "child.yaml"))
    assert any("circle: child.yaml → child.yaml" in line for line in itself)


def test_mistakes_are_told_with_the_place_in_their_own_file(toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("by: 3", "by: many"))
    found = problems(toy, CHILD + "stages:\n  pairs: {colour: 1}\n  none: {by: 1}\n  away: null\n  nine: 9\n")
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
    found = problems(toy, CHILD.replace("wf.yaml", extends))
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
    assert "at most 50 files are allowed" in problems(toy, CHILD.replace("wf.yaml", "c0.yaml"))[-1]
