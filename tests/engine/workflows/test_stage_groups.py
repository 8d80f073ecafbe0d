"""Groups of stages: shared by workflows, replaced, extended and removed as one, and invisible to the cache."""

from __future__ import annotations

from typing import Any

import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.plan_commands import explain_unit
from pano_mvs.core.errors import UsageError, WorkflowError
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.engine.workflows.wiring import wire
from pano_mvs.engine.workflows.workflow import Workflow, load_workflow
from pano_mvs.session.session import open_session, presets_folder
from tests.engine.conftest import Toy

GROUPED = """\
pano_mvs: 1
name: toy
plugins: [plug.py]
stages:
  numbers: {group: numbers.yaml}
  relations:
    description: how numbers relate
    stages:
      pairs:      {use: toy.pairs}
      difference: {use: toy.difference, in: {ends: scaled}}
      shifted:    {use: toy.shifted, in: {xs: scaled}}
  means:
    stages:
      views: {use: toy.views, in: {names: images}}
      mean:  {use: toy.mean, in: {own: scaled, around: scaled}}
  each: {use: toy.write_each}
  all:  {use: toy.write}
"""
NUMBERS = """\
pano_mvs: 1
description: the numbers, scaled
stages:
  images: {use: toy.source, path: capture}
  scaled: {use: toy.scale, by: 3}
"""
CHILD = "pano_mvs: 1\nname: child\nextends: grouped.yaml\n"


@pytest.fixture
def grouped(toy: Toy) -> Toy:
    """The toy workflow in groups, as grouped.yaml beside the other one."""
    (toy.folder / "grouped.yaml").write_text(GROUPED)
    (toy.folder / "numbers.yaml").write_text(NUMBERS)
    return toy


def load(toy: Toy, text: str, *overrides: str) -> Workflow:
    (toy.folder / "child.yaml").write_text(text)
    return load_workflow(toy.folder / "child.yaml", Registry(), overrides=overrides, presets=presets_folder())


def problems(toy: Toy, text: str, *overrides: str) -> list[str]:
    with pytest.raises(WorkflowError) as caught:
        load(toy, text, *overrides)
    return [line.replace(f"{toy.folder}/", "") for line in caught.value.problems]


def members(workflow: Workflow) -> dict[str, list[str]]:
    return {name: list(group.stages) for name, group in workflow.groups.items()}


def settings(workflow: Workflow, stage: str) -> dict[str, Any]:
    return workflow.stages[stage].params.model_dump()


def test_groups_change_nothing_but_what_is_shown(grouped: Toy) -> None:
    flat, workflow = grouped.session().workflow, load(grouped, GROUPED)
    assert resolved_yaml(workflow, wire(workflow)) == resolved_yaml(flat, wire(flat))
    assert workflow.id == flat.id
    assert members(workflow) == {
        "numbers": ["images", "scaled"],
        "relations": ["pairs", "difference", "shifted"],
        "means": ["views", "mean"],
    }
    assert workflow.groups["numbers"].description == "the numbers, scaled"
    assert workflow.groups["relations"].description == "how numbers relate"
    assert [entry.group for entry in workflow.stages.values()][-3:] == ["means", "", ""]
    assert [path.name for path in workflow.files] == ["numbers.yaml", "child.yaml"]
    assert f"# group: {grouped.folder / 'numbers.yaml'}\n{NUMBERS}" in workflow.text


def test_a_stage_of_a_group_is_overridden_by_its_name_and_removed(grouped: Toy) -> None:
    child = load(grouped, CHILD + "stages: {scaled: {by: 5}, shifted: null, all: null}")
    assert settings(child, "scaled") == {"by": 5.0}
    assert members(child)["relations"] == ["pairs", "difference"]
    assert load(grouped, CHILD, "scaled.by=7").stages["scaled"].params.model_dump() == {"by": 7.0}
    same = load(grouped, CHILD + "stages: {numbers: {stages: {scaled: {by: 5}}}}")
    assert settings(same, "scaled") == {"by": 5.0}
    assert members(same) == members(load(grouped, CHILD))
    here = GROUPED.replace(
        "{group: numbers.yaml}", "{group: numbers.yaml, stages: {scaled: {by: 4}}}\n  scaled: {by: 5}"
    )
    assert settings(load(grouped, here), "scaled") == {"by": 5.0}


def test_a_group_is_extended(grouped: Toy) -> None:
    """A new stage stands beside its neighbour in the group, else at the end of the group."""
    last = load(grouped, CHILD + "stages: {each: {}, numbers: {stages: {twice: {use: toy.scale}}}}")
    assert list(last.stages)[:4] == ["images", "scaled", "twice", "pairs"]
    inside = load(grouped, CHILD + "stages: {numbers: {stages: {twice: {use: toy.scale}, scaled: {}}}}")
    assert members(inside)["numbers"] == ["images", "twice", "scaled"]
    beside = load(grouped, CHILD + "stages: {images: {}, twice: {use: toy.scale}}")
    assert members(beside)["numbers"] == ["images", "twice", "scaled"]
    behind = load(grouped, CHILD + "stages: {numbers: {}, twice: {use: toy.scale}}")
    assert list(behind.stages)[:4] == ["images", "scaled", "twice", "pairs"]
    assert members(behind)["numbers"] == ["images", "scaled"]
    both = load(grouped, CHILD + "stages: {numbers: {stages: {scaled: {by: 1}}}, twice: {use: toy.scale}}")
    assert (list(both.stages)[2], both.stages["twice"].group) == ("twice", "")
    described = load(grouped, CHILD + "stages: {means: {description: the means, stages: {mean: {retries: 1}}}}")
    assert described.groups["means"].description == "the means"


def test_a_group_is_replaced_at_its_place(grouped: Toy) -> None:
    (grouped.folder / "mine.yaml").write_text(
        "pano_mvs: 1\nstages:\n  scaled: {use: toy.scale}\n  images: {use: toy.source, path: capture}\n"
        "  again: {use: toy.scale, in: {x: images}}\n"
    )
    child = load(grouped, CHILD + "stages: {numbers: {group: mine.yaml, stages: {again: {by: 9}}}, means: {}}")
    assert list(child.stages)[:4] == ["scaled", "images", "again", "pairs"]
    assert settings(child, "scaled") == {"by": 2.0}, "nothing of the old group is left"
    assert settings(child, "again") == {"by": 9.0}
    assert child.groups["numbers"].description == "the numbers, scaled"
    by_option = load(grouped, CHILD, f"numbers.group={grouped.folder / 'mine.yaml'}", "again.by=4")
    assert list(by_option.stages)[:4] == ["scaled", "images", "again", "pairs"]
    assert settings(by_option, "again") == {"by": 4.0}
    gone = problems(grouped, CHILD + "stages: {means: {group: numbers.yaml}, views: {retries: 1}}")
    assert any("stage 'images' is in the group 'numbers' already" in line for line in gone)
    assert any("stage 'views' needs `use: NAME`" in line for line in gone)


def test_a_group_is_removed(grouped: Toy) -> None:
    child = load(grouped, CHILD + "stages: {means: null, mine: {use: toy.scale}, each: null}")
    assert list(child.stages) == ["images", "scaled", "pairs", "difference", "shifted", "mine", "all"]
    assert "means" not in child.groups
    assert list(load(grouped, CHILD, "means=null", "each=null").stages) == [
        *("images", "scaled", "pairs", "difference", "shifted", "all")
    ]
    again = load(grouped, CHILD + "stages: {means: null, mean: {use: toy.mean, in: {around: images, own: images}}}")
    assert again.stages["mean"].group == ""
    emptied = load(grouped, CHILD + "stages: {views: null, mean: null, each: null}")
    assert "means" not in emptied.groups


def test_two_workflows_in_a_list_are_merged_stage_by_stage(grouped: Toy) -> None:
    """Groups do not replace each other: the files would not know of it."""
    (grouped.folder / "other.yaml").write_text(
        "pano_mvs: 1\nstages: {numbers: {stages: {scaled: {use: toy.scale, by: 8}, more: {use: toy.scale}}}}\n"
    )
    child = load(grouped, CHILD.replace("grouped.yaml", "[grouped.yaml, other.yaml]"))
    assert members(child)["numbers"] == ["images", "scaled", "more"]
    assert settings(child, "scaled") == {"by": 8.0}
    (grouped.folder / "flat.yaml").write_text("pano_mvs: 1\nstages: {scaled: {use: toy.scale, in: {x: images}}}\n")
    child = load(grouped, CHILD.replace("grouped.yaml", "[flat.yaml, grouped.yaml]"))
    assert set(members(child)["numbers"]) == {"images", "scaled"}, "a stage that was in no group before"
    (grouped.folder / "part.yaml").write_text("pano_mvs: 1\nstages: {numbers: {stages: {more: {use: toy.scale}}}}\n")
    child = load(grouped, CHILD.replace("grouped.yaml", "[grouped.yaml, part.yaml]"))
    assert members(child)["numbers"] == ["images", "scaled", "more"]
    assert list(child.stages)[3] == "pairs"


def test_a_group_file_may_extend_another_one_and_bring_plugins(grouped: Toy) -> None:
    inner = grouped.folder / "shared"
    inner.mkdir()
    (inner / "more.yaml").write_text(
        "pano_mvs: 1\nextends: ../numbers.yaml\nplugins: [../plug.py]\nstages: {scaled: {by: 6}}\n"
    )
    text = GROUPED.replace("plugins: [plug.py]\n", "").replace("numbers.yaml", "shared/more.yaml")
    workflow = load(grouped, text)
    assert settings(workflow, "scaled") == {"by": 6.0}
    assert settings(workflow, "images")["path"].resolve() == grouped.folder / "capture"
    assert [path.name for path in workflow.files] == ["numbers.yaml", "more.yaml", "child.yaml"]


def test_a_setting_may_be_called_group(grouped: Toy) -> None:
    """As that of `poses.scale`, which an override in a group, or beside it, changes."""
    grouped.edit(
        "plug.py", lambda text: text.replace("    by: float = 2.0\n", "    by: float = 2.0\n    group: int = 0\n")
    )
    inside = GROUPED.replace("{group: numbers.yaml}", "{group: numbers.yaml, stages: {scaled: {group: 2}}}")
    assert settings(load(grouped, inside), "scaled")["group"] == 2
    beside = GROUPED + "  scaled: {group: 3}\n"
    assert settings(load(grouped, beside), "scaled")["group"] == 3
    assert settings(load(grouped, CHILD + "stages: {numbers: {stages: {scaled: {group: 4}}}}"), "scaled")["group"] == 4
    assert settings(load(grouped, CHILD, "scaled.group=5"), "scaled")["group"] == 5


def test_a_workflow_may_be_a_group_but_not_its_own(grouped: Toy) -> None:
    text = "pano_mvs: 1\nplugins: [plug.py]\nstages: {all_of_it: {group: wf.yaml}}\n"
    assert members(load(grouped, text)) == {"all_of_it": list(grouped.session().workflow.stages)}


def test_groups_with_the_name_of_an_older_stage_lose_it(grouped: Toy) -> None:
    """A workflow that was written before the groups of what it extends is as valid as before."""
    child = load(grouped, CHILD + "stages: {scaled: {}, means: {use: toy.scale}}")
    assert list(child.stages)[:3] == ["images", "scaled", "means"]
    assert (child.stages["means"].group, child.stages["mean"].group) == ("numbers", "")
    (warning,) = child.warnings
    assert "child.yaml:4:22: stage 'means' has the name of a group" in warning


@pytest.mark.parametrize(
    ("stages", "what"),
    [
        ("{a: {group: nothing.yaml}}", "child.yaml:4:21: group: there is no file nothing.yaml and no shipped group"),
        ("{a: {group: number.yaml}}", "Did you mean 'numbers.yaml'"),
        ("{a: {group: camera}}", "no shipped group 'camera'. Did you mean 'cameras'?"),
        ("{a: {group: 3}}", "child.yaml:4:21: group: must be a file with the stages of the group, or a shipped group"),
        ("{a: {group: child.yaml}}", "child.yaml:4:21: group: the group contains itself: child.yaml → child.yaml"),
        (
            "{a: {group: circle.yaml}}",
            "circle.yaml:2:10: extends: the files extend each other in a circle: child.yaml →",
        ),
        ("{a: {group: self.yaml}}", "self.yaml:2:21: group: the group contains itself: self.yaml → self.yaml"),
        ("{a: {group: grouped.yaml}}", "group 'a': grouped.yaml contains groups itself (numbers, relations, means)"),
        ("{a: {stages: {b: {stages: {c: {use: toy.scale}}}}}}", "child.yaml:4:23: group 'a': 'b' is a group, too"),
        ("{numbers: {group: wrong.yaml}}", "wrong.yaml:2:61: stage 'scaled': there is no stage 'toy.scael'"),
        ("{a: {group: new.yaml}}", "new.yaml:1:11: workflow format 2 is not supported; this version reads 1. A newer"),
        ("{a: {group: none.yaml}}", "none.yaml:2:9: `stages:` must be a mapping"),
        ("{a: {group: list.yaml}}", "list.yaml:1:1: a workflow must be a mapping"),
        ("{a: {stages: {}}}", "child.yaml:4:10: group 'a' has no stages"),
        ("{a: {stages: }}", "child.yaml:4:10: group 'a' has no stages"),
        ("{a: {group: numbers.yaml, stages: {images: , scaled: }}}", "child.yaml:4:10: group 'a' has no stages"),
        ("{a: {stages: [scaled]}}", "child.yaml:4:22: group 'a': `stages:` must be a mapping of stage names"),
        ("{a: {group: numbers.yaml}}", "group 'a': stage 'images' is in the group 'numbers' already"),
        (
            "{a: {stages: {each: {use: toy.scale}}}}",
            "child.yaml:4:23: group 'a': stage 'each' is beside the groups already",
        ),
        (
            "{a: {stages: {b: {use: toy.scale}}}, c: {stages: {b: {}}}}",
            "group 'c': stage 'b' is in the group 'a' already",
        ),
        ("{a: {stages: {a: {use: toy.scale}}}}", "child.yaml:4:23: stage 'a' has the name of a group"),
        ("{a: {stages: {means: {use: toy.scale}}}}", "child.yaml:4:23: stage 'means' has the name of a group"),
        (
            "{a: {stages: {b: {use: toy.scale}}}, b: {group: x}}",
            "child.yaml:4:50: 'b' is a stage, and 'group' is for groups",
        ),
        (
            "{scaled: {group: numbers.yaml}}",
            "'scaled' is a stage, and 'group' is for groups; groups of this workflow: numb",
        ),
        ("{scaled: {stages: {}}}", "child.yaml:4:19: 'scaled' is a stage, and 'stages' is for groups"),
        ("{means: {retries: 2}}", "child.yaml:4:10: 'means' is a group of stages: write `means: {stages: {STAGE: …}}`"),
        ("{means: 3}", "'means' is a group of stages"),
        ("{means: {group: numbers.yaml, retries: 2}}", "child.yaml:4:39: group 'means': unknown key 'retries'"),
        ("{means: {stages: {mean: {}}, description: 3}}", "group 'means': description must be text"),
        ("{numbers: {stages: null}}", "`stages:` is empty, which changes nothing; `numbers: null` removes the group"),
        ("{../a: {stages: {b: {use: toy.scale}}}}", "group name '../a' must consist of letters"),
        ("{a: {stages: {b: {retries: 1}}}}", "child.yaml:4:23: stage 'b' needs `use: NAME`"),
        ("{means: {stages: {meen: }}}", "stage 'meen' needs `use: NAME`; there is no stage of that name to remove"),
    ],
)
def test_mistakes_in_groups_are_reported_with_their_place(grouped: Toy, stages: str, what: str) -> None:
    for name, text in {
        "circle": "pano_mvs: 1\nextends: child.yaml",
        "self": "pano_mvs: 1\nstages: {b: {group: self.yaml}}",
        "wrong": "pano_mvs: 1\nstages: {s: {use: toy.source, path: capture}, scaled: {use: toy.scael}}",
        "new": "pano_mvs: 2\nstages: {b: {use: toy.scale}}",
        "none": "pano_mvs: 1\nstages: {}",
        "list": "[a]",
    }.items():
        (grouped.folder / f"{name}.yaml").write_text(text)
    found = problems(grouped, CHILD + f"stages: {stages}")
    assert any(what in line for line in found), found


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("means.retries=2", "'means' is a group of stages; set a setting of one of them: views, mean"),
        ("means.group=nothing.yaml", "--set means.group: group: there is no file"),
        ("nothing.by=2", "no stage 'nothing'"),
        ("numbers.group=null", "numbers.group: give the file of a group, or the name of a shipped one; numbers=null"),
        ("means=3", "write STAGE.PARAM=VALUE"),
    ],
)
def test_mistakes_in_options_about_groups(grouped: Toy, override: str, what: str) -> None:
    found = problems(grouped, CHILD, override)
    assert any(what in line for line in found), found


@pytest.mark.parametrize(
    ("stages", "overrides", "what"),
    [
        (
            "{each: {}}",
            ("numbers=null",),
            "stage 'difference': port 'ends': stage 'scaled' was removed with the group 'numbers' "
            "(--set numbers); name another stage by `difference: {in: {ends: STAGE}}`, or remove 'difference' as well",
        ),
        ("{each: {}}", ("scaled=null",), "stage 'mean': port 'own': stage 'scaled' was removed (--set scaled)"),
        ("{scaled: null}", (), "stage 'mean': port 'own': stage 'scaled' was removed (child.yaml:4:10)"),
        (
            "{numbers: {group: other.yaml}}",
            (),
            "stage 'mean': port 'own': stage 'scaled' was replaced with the group 'numbers' (child.yaml:4:10)",
        ),
        (
            "{means: null, all: {in: {differences: means}}}",
            (),
            "port 'differences': group 'means' was removed (child.yaml:4:10)",
        ),
        (
            "{all: {in: {differences: numbers}}}",
            (),
            "port 'differences': 'numbers' is a group of stages; name one of its stages: images",
        ),
        (
            "{all: null, each: null, mean: null}",
            ("pairs=null",),
            "stage 'difference' needs an index index: One[Pairs], but no earlier stage produces Pairs (stage 'pairs' "
            "was removed (--set pairs)): name another stage by `difference: {in: {index: STAGE}}`",
        ),
        (
            "{images: null}",
            (),
            "stage 'scaled' needs x: Each[Number], but no earlier stage produces Number (stage 'images' was removed "
            "(child.yaml:4:10)): name another stage by `scaled: {in: {x: STAGE}}`",
        ),
    ],
)
def test_an_input_that_was_removed_is_named_with_the_place(
    grouped: Toy, stages: str, overrides: tuple[str, ...], what: str
) -> None:
    """It was called a stage that does not exist, with another one of a similar name."""
    (grouped.folder / "other.yaml").write_text("pano_mvs: 1\nstages: {images: {use: toy.source, path: capture}}\n")
    workflow = load(grouped, f"{CHILD}stages: {stages}\n", *overrides)
    with pytest.raises(WorkflowError) as caught:
        wire(workflow)
    said = [line.replace(f"{grouped.folder}/", "") for line in caught.value.problems]
    assert any(what in line for line in said), said


def test_options_take_the_names_of_groups(grouped: Toy) -> None:
    session = open_session(grouped.folder / "grouped.yaml", cache=grouped.folder / "cache")
    _, graph = RunOptions(until=("relations",)).applied_to(session.workflow, session.graph)
    assert graph.order == ("images", "scaled", "pairs", "difference", "shifted")
    _, graph = RunOptions(until=("scaled", "means")).applied_to(session.workflow, session.graph)
    assert graph.order == ("images", "scaled", "views", "mean")
    RunOptions(refresh=("means",)).applied_to(session.workflow, session.graph)
    with pytest.raises(UsageError, match="'means' is a group of stages; give one of its stages: views, mean"):
        RunOptions(only=("means:1.txt",)).applied_to(session.workflow, session.graph)
    with pytest.raises(
        UsageError, match=r"no stage 'nothing' in this workflow; it has: images.*; groups: numbers, relations"
    ):
        RunOptions(until=("nothing",)).applied_to(session.workflow, session.graph)
    with pytest.raises(UsageError, match="means is a group of stages; give a unit of one of them: views, mean"):
        explain_unit(session, "means:1.txt", Console())
