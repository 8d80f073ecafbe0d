"""What docs/plugins.md shows is what `plugin new` writes, which tests/cli/test_plugin_new.py runs."""

from __future__ import annotations

import json
import re
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pano_mvs import api
from pano_mvs.api import Context, RunStoppedError, TwoView
from pano_mvs.cli.app import app
from pano_mvs.cli.plugins.listing import DOORS
from pano_mvs.cli.plugins.new import EXAMPLES, KINDS, rendered
from pano_mvs.engine.stages.registry import ENTRY_POINT_GROUP, Registry
from pano_mvs.scene import RangeMap, Record
from pano_mvs.testing import conformance
from pano_mvs.testing.conformance import stage_contract_tests
from pano_mvs.testing.room import capture_poses, default_room
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.docs.pages import block, copy_plugin, text_of
from tests.synthetic.capture_files import write_capture
from tests.test_plugin_imports import PUBLIC

PAGE = text_of("plugins.md")
PLUGINS = dict(re.findall(r"<!-- plugin: (\w+) (\w+) -->\n", PAGE))


def test_the_page_has_one_plugin_of_each_kind() -> None:
    assert PLUGINS.keys() == KINDS.keys()


BESIDE_STAGES = [kind for kind in KINDS if not KINDS[kind].in_workflow]


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow) if kind == "command" else kind for kind in BESIDE_STAGES]
)
def test_an_example_beside_stages_keeps_its_contract(kind: str, tmp_path: Path) -> None:
    name = PLUGINS[kind]
    plugin = tmp_path / f"{name}.py"
    plugin.write_text(rendered(kind, name)[0])
    example = {"example": EXAMPLES[kind].format(name=name)} if kind in EXAMPLES else {}
    for contract_test in getattr(conformance, KINDS[kind].contract_tests)(plugin, **example):
        contract_test.check()


@pytest.mark.parametrize("kind", ["command", "executor", "observer", "pose_reader"])
def test_an_example_beside_stages_is_short(kind: str) -> None:
    assert len(rendered(kind, PLUGINS[kind])[0].splitlines()) < 40


def test_the_page_lists_the_groups_of_all_doors() -> None:
    table = re.findall(r"^\| `(pano_mvs\.\w+)` \| (?:a|an) ", PAGE.partition("### Offered by")[2], re.MULTILINE)
    assert set(table) == {ENTRY_POINT_GROUP, *(door.group for door in DOORS)}
    example = tomllib.loads(block("plugins.md", "entry points"))["project"]["entry-points"]
    assert example.keys() <= set(table)


def test_the_page_lists_the_public_modules() -> None:
    table = PAGE.partition("<!-- public modules -->")[2].partition("\n\n")[0]
    listed = set(re.findall(r"^\| `([\w.*]+)`", table, re.MULTILINE))
    assert listed == {*PUBLIC, "pano_mvs.core.*", "pano_mvs.testing.conformance"}
    for module, names in re.findall(r"^\| `([\w.]+)` \| (.*) \|$", table, re.MULTILINE):
        for name in re.findall(r"`(\w+)`", names):
            assert hasattr(import_module(module), name), f"{module}.{name}"
    kinds = set(re.findall(r"^\| .* \| `register_\w+` \| .* \| `(\w+)` \|$", PAGE, re.MULTILINE))
    assert kinds == {KINDS[kind].contract_tests for kind in BESIDE_STAGES}


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_names_the_command_that_writes_a_plugin(kind: str) -> None:
    text, command = rendered(kind, PLUGINS[kind])[0], f"pano-mvs plugin new {kind} {PLUGINS[kind]}"
    assert f"`{command}` writes [this plugin](../pano_mvs/cli/plugins/templates/{kind}.py.jinja)" in PAGE
    assert set(re.findall(r'^@\w+\(\s*"(?:\w+\.)*(\w+)"', text, re.MULTILINE)) == {PLUGINS[kind]}


def test_commands_on_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for command in block("plugins.md", "commands").splitlines():
        program, *arguments = command.split()
        if program == "pano-mvs":
            assert CliRunner().invoke(app, arguments).exit_code == 0
        else:
            assert program == "pytest"
            assert Path(arguments[0]).is_file()


def test_the_test_on_the_page_is_what_is_written() -> None:
    lines = block("plugins.md", "test").splitlines()
    assert set(lines) <= set(rendered("filter", "any")[1].splitlines())


def test_the_stage_with_the_settings_of_a_function_keeps_the_contract(tmp_path: Path) -> None:
    example = block("plugins.md", "settings")
    named = ", ".join(name for name in api.__all__ if re.search(rf"\b{name}\b", example))
    plugin = tmp_path / "beyond.py"
    imports = f"from typing import Annotated\nimport numpy as np\nfrom pano_mvs.api import {named}\n"
    plugin.write_text(imports + example)
    for contract_test in stage_contract_tests(plugin):
        contract_test.check()
    registry = Registry()
    registry.add_file(plugin)
    stage = registry.stages["filters.beyond"]
    seen = RangeMap(np.array([[0.2, 1.0, 3.0, np.nan]] * 2, np.float32), np.array([[200, 200, 200, 0]] * 2, np.uint8))
    settings: tuple[tuple[dict[str, float], int], ...] = (({}, 2), ({"near": 2.0}, 1))
    for given, count in settings:
        left = stage.function(range_map=seen, params=stage.params_type.model_validate(given))
        assert isinstance(left, RangeMap)
        assert left.valid.sum(axis=1).tolist() == [count, count]


@pytest.fixture
def solver(tmp_path: Path) -> Path:
    return copy_plugin("plugins.md", tmp_path)


def test_the_pose_solver_keeps_the_contract_and_finds_the_cameras(solver: Path) -> None:
    """The pairs of the tiny capture are exact, and so are the poses, except for the world frame and the scale."""
    for contract_test in stage_contract_tests(solver):
        contract_test.check()
    names: dict[str, Any] = {"__name__": "directions"}
    exec(solver.read_text(encoding="utf-8").replace("@stage(", "@(lambda name: lambda function: function)("), names)
    capture = tiny_capture(Variant((32, 64)))
    pairs = dict(capture.items[TwoView])
    ctx = Context(np.random.default_rng(0), solver.parent)
    poses = names["directions"](list(capture.names), pairs, names["DirectionsParams"](), ctx)
    assert poses.names == capture.names
    first = capture.poses[0]
    unit = np.linalg.norm(capture.poses[1].center - first.center)
    for idx, truth in enumerate(capture.poses):
        expected = truth @ first.inverse()
        np.testing.assert_allclose(poses.rotations[idx], expected.rotation, atol=1e-9)
        np.testing.assert_allclose(poses.translations[idx], expected.translation / unit, atol=1e-9)


def test_the_pose_solver_names_images_without_pairs_and_refuses_a_line(solver: Path) -> None:
    names: dict[str, Any] = {"__name__": "directions"}
    exec(solver.read_text(encoding="utf-8").replace("@stage(", "@(lambda name: lambda function: function)("), names)
    capture = tiny_capture(Variant((32, 64)))
    params, ctx = names["DirectionsParams"](), Context(np.random.default_rng(0), solver.parent)
    pairs = {pair: found for pair, found in capture.items[TwoView].items() if capture.names[-1] not in pair}
    poses = names["directions"](list(capture.names), pairs, params, ctx)
    assert list(poses.rejected) == [capture.names[-1]]
    with pytest.raises(RunStoppedError, match="no pair has enough matches"):
        names["directions"](list(capture.names), {}, params, ctx)
    chain = dict(list(pairs.items())[:1])
    chain[capture.names[1], capture.names[2]] = capture.items[TwoView][capture.names[1], capture.names[2]]
    with pytest.raises(RunStoppedError, match="do not determine the positions"):
        names["directions"](list(capture.names), chain, params, ctx)


@pytest.mark.slow
def test_the_pose_solver_runs_in_its_workflow(solver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.search(r"```yaml\n(pano_mvs: 1\nextends: .*?directions.py.*?)```", PAGE, re.DOTALL)
    assert found
    (tmp_path / "mine.yaml").write_text(found[1])
    write_capture(tmp_path / "room", default_room(), capture_poses(4, spread=0.4), size_hw=(160, 320))
    (tmp_path / "room" / "images").rename(tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PANO_MVS_CACHE", raising=False)
    result = CliRunner().invoke(app, ["run", "mine.yaml", "--until", "colmap"])
    assert result.exit_code == 0, result.output
    scored = CliRunner().invoke(app, ["evaluate", "poses", "out/mine", "--truth", "room/truth", "--json"])
    assert scored.exit_code == 0, scored.output
    scores = json.loads(scored.output)
    assert scores["registered"] == 4
    assert scores["pair_deg_all"]["median"] < 0.5


def test_the_kinds_on_the_page_are_those_of_the_api() -> None:
    listed = re.search(r"The kinds are records in `pano_mvs.api`: (.*?);", PAGE, re.DOTALL)
    assert listed
    kinds = {
        name for name in api.__all__ if isinstance(value := getattr(api, name), type) and issubclass(value, Record)
    }
    assert set(re.findall(r"`(\w+)`", listed.group(1))) == kinds - {"Record"}
