"""Sweeps side by side, and sweeps with parts of plugins."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json
from tests.cli.truth import range_errors
from tests.cli.workflows.test_workflows import known

SAD = ("--set", "depth_sad.planes=32")
ALIKE = ("--set", "depth.near=0.4", "--set", "depth.far=6", "--set", "depth_sad.near=0.4", "--set", "depth_sad.far=6")
KNOWN = "pano_mvs: 1\nname: both\nextends: [compare_sweeps, fixed.yaml]\n"
FIXED = """\
pano_mvs: 1
stages:
  pairs: {in: {poses: poses}}
  sift_poses: null
  weak: null
  learned: null
  likely: null
  rematched: null
  merged: null
  refined: null
  levelled: null
  verified: {correct: false, in: {poses: points}}
  poses: {use: poses.from_model, path: TRUTH/poses.json}
  points: {use: poses.triangulate, in: {poses: poses}}
  scores: {truth: TRUTH}
  scores_sad: {truth: TRUTH}
"""


def write_both(truth: Path) -> None:
    """Write a workflow with both sweeps, for true poses, into the current folder."""
    Path("fixed.yaml").write_text(FIXED.replace("TRUTH", str(truth)), encoding="utf-8")
    Path("both.yaml").write_text(KNOWN, encoding="utf-8")


@pytest.mark.slow
def test_two_sweeps_side_by_side(pano_mvs: Command, rendered: Path) -> None:
    write_both(rendered / "truth")
    arguments = (
        *f"--images {rendered / 'images'} --cache cache --set depth.planes=32".split(),
        *["--set", "features.max_keypoints=1500"],
        *ALIKE,
    )
    result = pano_mvs("run", "both.yaml", *arguments, *SAD, "--out", "both")
    assert result.code == 0, result.text
    summary = run_json(Path("both"))
    ours = range_errors(Path("both"), rendered / "truth")
    papers = range_errors(Path("both"), rendered / "truth", folder="sad/range")
    assert set(ours) == set(papers) == {f"00{number}" for number in range(4)}
    assert ours != papers
    assert all(errors.near > 0.5 for errors in ours.values())
    files = {path.relative_to("both").as_posix() for path in Path("both").rglob("*.*") if path.is_file()}
    assert {"cloud.ply", "range/000.tiff", "preview/000.jpg"} <= files
    assert {"sad/cloud.ply", "sad/range/000.tiff", "sad/confidence/000.png", "sad/preview/000.jpg"} <= files
    assert summary["views"][0]["preview"] == "preview/000.jpg"

    known_poses = pano_mvs("run", "known_poses", *known(rendered), *ALIKE[:4], *["--cache", "cache", "--out", "alone"])
    assert known_poses.code == 0, known_poses.text
    alone = {stage["name"]: stage["run"] for stage in run_json(Path("alone"))["stages"]}
    assert alone == dict.fromkeys(alone, 0), "the same stages have the same keys, whatever is beside them"


def test_without_in_a_second_branch_is_ambiguous_and_the_message_says_what_to_write(pano_mvs: Command) -> None:
    Path("two.yaml").write_text(
        "pano_mvs: 1\nextends: quickstart\nstages:\n  other: {use: depth.sweep}\n  median: {use: filters.median}\n"
    )
    result = pano_mvs("check", "two.yaml")
    assert result.code == 2
    assert "two.yaml:5:17: stage 'median': port range_map: Each[RangeMap] could be fed by" in result.flat
    assert "smooth, planes, other; choose with `in: {range_map: …}`" in result.flat


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
