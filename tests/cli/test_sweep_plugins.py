"""A stranger's backend and cost, in a file that the workflow names: checked, run, and cached by their code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json

WORKFLOW = """\
pano_mvs: 1
plugins: [mine.py]
stages:
  images: {use: source.folder, path: capture/images}
  poses:  {use: poses.from_model, path: capture/truth/poses.json}
  views:  {use: views.nearest, sources: 2}
  depth:  {use: depth.sweep, planes: 16, near: 0.5, far: 6, aggregation: box, backend: opencv, cost: rank}
"""
PLUGIN = '''\
from pano_mvs.api import SweepInput, Winners, register_sweep_backend, register_sweep_cost


@register_sweep_cost("rank")
def rank_cost(reference, warped, window):
    """The difference of ranks among the neighbours."""
    ranks = [sum(near < image for near in window.neighbours(image)) for image in (reference[..., 0], warped[..., 0])]
    return abs(ranks[0] - ranks[1]) / window.columns.shape[1] ** 2


@register_sweep_backend("mine", costs=["sad"])
def find_winners(work: SweepInput) -> Winners:
    from pano_mvs.algorithms.sweep.backends.numpy_backend import find_winners

    return find_winners(work)
'''


@pytest.fixture
def workflow(capture: Path) -> Path:
    for folder in ("images", "truth"):
        for path in sorted((capture / folder).glob("003*")):
            path.unlink()
    (capture.parent / "mine.py").write_text(PLUGIN)
    path = capture.parent / "plugins.yaml"
    path.write_text(WORKFLOW)
    return path


@pytest.mark.slow
def test_a_plugins_cost_is_run_and_cached_by_its_code(pano_mvs: Command, workflow: Path) -> None:
    result = pano_mvs("run", workflow)
    assert result.code == 0, result.text
    metrics = run_json(Path("out/plugins"))["stages"]
    assert metrics
    assert "0 units computed" in pano_mvs("run", workflow).flat
    plugin = workflow.parent / "mine.py"
    plugin.write_text("# a comment\n" + plugin.read_text())
    assert "0 units computed" in pano_mvs("run", workflow).flat
    plugin.write_text(plugin.read_text().replace("near < image", "near <= image"))
    assert "code of depth.sweep changed" in pano_mvs("plan", workflow).flat
    assert "nothing to compute" in pano_mvs("plan", workflow, "--accept-code").flat
    assert "3 units computed" in pano_mvs("run", workflow).flat


@pytest.mark.slow
def test_a_plugins_backend_is_run(pano_mvs: Command, workflow: Path) -> None:
    result = pano_mvs("run", workflow, "--set", "depth.backend=mine", "--set", "depth.cost=sad")
    assert result.code == 0, result.text


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        (["depth.cost=rnak"], "there is no sweep cost 'rnak'; did you mean 'rank'?"),
        (["depth.backend=opencl"], "there is no sweep backend 'opencl'; did you mean 'opencv'?"),
        (["depth.backend=numba"], "'numba' does not have the cost 'rank'; those that do: numpy, opencv"),
        (["depth.backend=mine"], "'mine' does not have the cost 'rank'; those that do: numpy, opencv"),
        (["depth.device=gpu"], "depth.device"),
    ],
)
def test_names_that_cannot_work_are_found_by_check(
    pano_mvs: Command, workflow: Path, settings: list[str], what: str
) -> None:
    result = pano_mvs("check", workflow, *[part for setting in settings for part in ("--set", setting)])
    assert result.code == 2
    assert what in result.flat


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("@register_sweep_cost('census')\ndef cost(r, w, window): ...\n", "the sweep cost 'census' is built in"),
        ("@register_sweep_backend('a b')\ndef find(work): ...\n", "cannot be called 'a b'"),
        ("x = register_sweep_cost\n", "defines no stage"),
    ],
)
def test_parts_that_cannot_be_registered_say_where(pano_mvs: Command, workflow: Path, code: str, what: str) -> None:
    (workflow.parent / "mine.py").write_text(
        "from pano_mvs.api import register_sweep_backend, register_sweep_cost\n" + code
    )
    result = pano_mvs("check", workflow)
    assert result.code == 2
    assert what in result.flat
    assert "mine.py" in result.flat


def test_one_name_in_two_plugins_is_a_mistake_that_names_both(pano_mvs: Command, workflow: Path) -> None:
    (workflow.parent / "other.py").write_text(PLUGIN)
    workflow.write_text(WORKFLOW.replace("[mine.py]", "[mine.py, other.py]"))
    result = pano_mvs("check", workflow)
    assert result.code == 2
    assert "sweep cost 'rank' is defined twice" in result.flat
    assert "mine.py:" in result.flat
    assert "other.py:" in result.flat
