"""The JSON Schema of workflows: it knows all that the engine knows, and an independent validator agrees with both."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from ruamel.yaml import YAML

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.editor_schema import workflow_schema
from pano_mvs.engine.workflows.policy import RESERVED_KEYS
from pano_mvs.engine.workflows.workflow import WorkflowReader
from pano_mvs.session.session import presets_folder
from tests.engine.toy import HELPER, PLUGIN
from tests.presets import usable_presets


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    made = workflow_schema(Registry.installed())
    jsonschema.Draft202012Validator.check_schema(made)
    return made


def mistakes(schema: dict[str, Any], text: str) -> list[str]:
    """Return what a validator has to say of a workflow."""
    value = YAML(typ="safe", pure=True).load(textwrap.dedent(text))
    return [error.message for error in jsonschema.Draft202012Validator(schema).iter_errors(value)]


@pytest.mark.parametrize("path", usable_presets(), ids=lambda path: path.stem)
def test_shipped_workflows_are_valid(schema: dict[str, Any], path: Path) -> None:
    assert mistakes(schema, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", sorted((presets_folder() / "groups").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_groups_are_valid(schema: dict[str, Any], path: Path) -> None:
    assert mistakes(schema, path.read_text(encoding="utf-8")) == []


HEAD = "pano_mvs: 1\nstages:\n  images: {use: source.folder, path: x}\n"


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "pano_mvs: 2\nstages: {a: {use: pairs.exhaustive}}",
        "pano_mvs: 1",
        "pano_mvs: 1\nstages: {}",
        "pano_mvs: 1\nstages: [a]",
        "pano_mvs: 1\nstagse: {a: {use: pairs.exhaustive}}",
        "pano_mvs: 1\nstages: {a: {use: pairs.exhaustiv}}",
        "pano_mvs: 1\nstages: {a: {path: x}}",
        "pano_mvs: 1\nstages: {../a: {use: pairs.exhaustive}}",
        "pano_mvs: 1\nstages: {a: null}",
        "pano_mvs: 1\nstages: {a: {use: source.folder}}",
        "pano_mvs: 1\nplugins: a.py\nstages: {a: {use: pairs.exhaustive}}",
        HEAD + "  a: {use: depth.sweep, plans: 3}",
        HEAD + "  a: {use: depth.sweep, planes: many}",
        HEAD + "  a: {use: depth.sweep, planes: 1}",
        HEAD + "  a: {use: depth.sweep, spacing: even}",
        HEAD + "  a: {use: depth.sweep, cost: censsus}",
        HEAD + "  a: {use: depth.sweep, in: {poses: images}}",
        HEAD + "  a: {use: depth.sweep, on_error: ignore}",
        HEAD + "  a: {use: depth.sweep, retries: -1}",
        HEAD + "  a: {use: depth.sweep, min_success: 2}",
        HEAD + "  a: {use: depth.sweep, gate: {completeness: high}}",
        HEAD + "  a: {use: depth.sweep, gate: {completeness: {mim: 1}}}",
        HEAD + "  a: {use: depth.sweep, gate: {completeness: {}}}",
        HEAD + "  a: {use: nobodys.stage}",
        HEAD + "  a: {use: nobodys.stage, optional: false}",
        HEAD + "  a: {use: 3, optional: true}",
        HEAD + "  a: {optional: true}",
        HEAD + "  a: {use: depth.sweep, optional: true, plans: 3}",
        "pano_mvs: 1\nextends: quickstart\nstages: {a: {use: nobodys.stage}}",
        HEAD + "  a: {group: 3, stages: {}}",
        HEAD + "  a: {group: a.yaml, retries: 2}",
        HEAD + "  a: {group: a.yaml, stages: [b]}",
        HEAD + "  a: {group: a.yaml, stages: {../b: {use: pairs.exhaustive}}}",
        HEAD + "  a: {stages: {b: {use: nobodys.stage}}}",
        HEAD + "  a: {stages: {b: {use: depth.sweep, planes: many}}}",
        HEAD + "  a: {stages: {b: {use: pairs.exhaustive}}, description: [c]}",
        HEAD + "  a: {stages: {b: {use: pairs.exhaustive}}}\n  c: {planes: 64}",
    ],
)
def test_wrong_workflows_are_not(schema: dict[str, Any], text: str) -> None:
    assert mistakes(schema, text)


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "  a: {stages: {b: {use: pairs.exhaustive}}, description: pairs}",
        HEAD + "  a: {group: a.yaml}\n  depth: {planes: 64}\n  smooth:",
        HEAD + "  a: {group: a.yaml, stages: {depth: {planes: 64}, smooth: }}",
        "pano_mvs: 1\nextends: quickstart\nstages: {cameras: , sweep: {stages: {depth: {planes: 64}}}, a: {group: x}}",
        "pano_mvs: 1\nextends: quickstart\nstages: {metres: {group: 1}}",
    ],
)
def test_groups_are_valid(schema: dict[str, Any], text: str) -> None:
    assert mistakes(schema, text) == []


def test_the_stages_of_groups_are_known(tmp_path: Path) -> None:
    registry = Registry.installed()
    reader = WorkflowReader("t", tmp_path, registry, presets=presets_folder())
    text = "pano_mvs: 1\nstages:\n  sweep: {group: sweep"
    made = workflow_schema(registry, *reader.inherited(text + "}", tmp_path / "t.yaml"))
    assert mistakes(made, text + ", stages: {depth: {planes: 64}}}\n  views: {sources: 2}") == []
    assert mistakes(made, text + ", stages: {depth: {plans: 64}}}")
    assert mistakes(made, text + "}\n  views: {source: 2}")


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "  a: {use: depth.sweep, gate: {completeness: 0.5, far: {max: 100}}, retries: null, to: draft}",
        HEAD + "  a: {use: depth.sweep, near: null, in: {ref: images}, memory: 2GB, timeout_s: 10}",
        HEAD + "  a: {use: nobodys.stage, optional: true, by: 3, in: {poses: images}}",
        HEAD + "  a: {use: depth.sweep, optional: true, planes: 3}",
        "pano_mvs: 1\nextends: quickstart",
        "pano_mvs: 1\nextends: quickstart\nstages: {a: {use: nobodys.stage, optional: true, by: 3}}",
        "pano_mvs: 1\nextends: [quickstart, a.yaml]\nstages: {depth: {planes: 64}, smooth: , d: {use: depth.sweep}}",
    ],
)
def test_right_ones_are(schema: dict[str, Any], text: str) -> None:
    assert mistakes(schema, text) == []


def test_it_describes_what_an_editor_shows(schema: dict[str, Any]) -> None:
    registry = Registry.installed()
    used = schema["$defs"]["stage"]["else"]["properties"]["use"]
    assert set(used["enum"]) == set(registry.stages)
    assert schema["$defs"]["stage"]["then"]["properties"]["use"]["anyOf"][0] == used, "optional ones are offered, too"
    for name, spec in registry.stages.items():
        settings = schema["$defs"][f"use.{name}"]
        assert set(settings["properties"]) == {*spec.params_type.model_fields, *RESERVED_KEYS}
        assert set(settings["properties"]["in"]["anyOf"][0]["properties"]) == {port.name for port in spec.all_ports}
        assert settings["description"]
        for key, value in settings["properties"].items():
            described = value if "$ref" not in value else schema["$defs"][value["$ref"].rpartition("/")[2]]
            assert described.get("description"), f"{name}: {key} has no description"
    planes = schema["$defs"]["use.depth.sweep"]["properties"]["planes"]
    assert (planes["minimum"], planes["maximum"], planes["default"]) == (3, 4096, 128)
    cost = schema["$defs"]["use.depth.sweep"]["properties"]["cost"]
    assert {"census", "sad", "zncc"} <= set(cost["enum"])


@pytest.mark.slow
def test_stages_and_settings_of_a_workflows_plugins_and_of_what_it_extends_are_known(tmp_path: Path) -> None:
    (tmp_path / "plug.py").write_text(PLUGIN)
    (tmp_path / "helper.py").write_text(HELPER)
    text = "pano_mvs: 1\nextends: quickstart\nplugins: [plug.py]\nstages: {}\n"
    registry = Registry.installed()
    reader = WorkflowReader("t", tmp_path, registry, presets=presets_folder())
    made = workflow_schema(registry, *reader.inherited(text, tmp_path / "t.yaml"))
    jsonschema.Draft202012Validator.check_schema(made)
    assert mistakes(made, "pano_mvs: 1\nextends: quickstart\nstages: {s: {use: toy.scale, by: 3}}") == []
    assert mistakes(made, "pano_mvs: 1\nextends: quickstart\nstages: {depth: {planes: 64}, smooth: }") == []
    assert mistakes(made, "pano_mvs: 1\nextends: quickstart\nstages: {depth: {plans: 64}}")
    other = "pano_mvs: 1\nextends: quickstart\nstages: {depth: {use: toy.scale, by: 2}}"
    assert mistakes(made, other) == []
    assert mistakes(made, other.replace("by", "planes"))
