"""Pair selectors inside a workflow, on a tiny rendered capture."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.cli.conftest import Command, Outcome, run_json

WORKFLOW = """\
pano_mvs: 1
stages:
  images:   {{use: source.folder, path: {images}}}
  features: {{use: features.{features}, max_keypoints: 1500}}
  {looks}
  pairs:    {{use: pairs.{selector}}}
  matches:  {{use: matches.brute_force}}
  poses:    {{use: poses.scaled_translation}}
  refined:  {{use: poses.refine}}
  export:   {{use: export.colmap}}
"""
LOOKS = "looks:    {use: global.vlad}"


def run(
    pano_mvs: Command, capture: Path, selector: str, *, features: str = "sift_tangent", looks: str = LOOKS
) -> Outcome:
    Path("pairs.yaml").write_text(
        WORKFLOW.format(images=capture / "images", selector=selector, looks=looks, features=features)
    )
    return pano_mvs("run", "pairs.yaml", "--out", "out")


@pytest.mark.slow
def test_every_picture_is_registered_and_looks_are_kept(pano_mvs: Command, capture: Path) -> None:
    """One more picture leaves the global descriptors of the others as they are."""
    last = sorted((capture / "images").iterdir())[-1]
    aside = last.rename(capture / last.name)
    assert run(pano_mvs, capture, "retrieval, neighbours: 2").code == 0
    aside.rename(last)
    for selector in ("retrieval, neighbours: 2", "sequential, window: 1, loop_closure: 2"):
        outcome = run(pano_mvs, capture, selector)
        assert outcome.code == 0, outcome.text
        assert len(run_json(Path("out"))["poses"]["registered"]) == 4
        (looks,) = (stage for stage in run_json(Path("out"))["stages"] if stage["name"] == "looks")
        assert (looks["run"], looks["cached"]) == ((1, 3) if selector.startswith("retrieval") else (0, 4))
    outcome = run(pano_mvs, capture, f"position, path: {capture / 'truth' / 'poses.json'}, neighbours: 3", looks="")
    assert outcome.code == 0, outcome.text
    assert len(run_json(Path("out"))["poses"]["registered"]) == 4


def test_loop_closure_needs_looks_and_says_so(pano_mvs: Command, capture: Path) -> None:
    outcome = run(pano_mvs, capture, "sequential, loop_closure: 2", looks="")
    assert outcome.code != 0
    assert "global.vlad" in outcome.flat


def test_pictures_without_positions_are_a_clear_error(pano_mvs: Command, capture: Path) -> None:
    outcome = run(pano_mvs, capture, "position", looks="")
    assert outcome.code != 0
    assert "no image has a position" in outcome.flat
    assert "pairs.retrieval" in outcome.flat


def test_pairs_are_bounded_by_themselves_and_the_plan_knows_how_many(pano_mvs: Command, capture: Path) -> None:
    Path("pairs.yaml").write_text(
        WORKFLOW.format(images=capture / "images", selector="auto, candidates: 1", looks=LOOKS, features="sift_tangent")
    )
    plan = pano_mvs("plan", "pairs.yaml", "--out", "out")
    assert re.search(r"matches\W+matches.brute_force\W+about 4\b", plan.flat), plan.flat
    outcome = pano_mvs("run", "pairs.yaml", "--out", "out", "--until", "matches")
    assert "of the 6 pairs of 4 images are matched, at most 1 for each" in outcome.flat
    found = run_json(Path("out"))["stages"]
    assert next(stage for stage in found if stage["name"] == "matches")["run"] in (3, 4)


def test_positions_without_rotations_choose_pairs(pano_mvs: Command, capture: Path) -> None:
    names = sorted(path.name for path in (capture / "images").iterdir())
    Path("survey.csv").write_text("\n".join(["name;x;y;z", *(f"{name};{idx};0;0" for idx, name in enumerate(names))]))
    selector = "position, path: survey.csv, neighbours: 1"
    text = WORKFLOW.format(images=capture / "images", selector=selector, looks=LOOKS, features="orb_tangent")
    Path("pairs.yaml").write_text(text)
    outcome = pano_mvs("run", "pairs.yaml", "--out", "out", "--until", "pairs")
    assert outcome.code == 0, outcome.text
    (stage,) = [stage for stage in run_json(Path("out"))["stages"] if stage["name"] == "pairs"]
    assert stage["metrics"]["located"] == 1
    assert stage["metrics"]["pairs"] == len(names) - 1


def test_known_poses_choose_pairs(pano_mvs: Command, capture: Path) -> None:
    """Poses from a file before the selector are positions, if there are too many images to match all pairs."""
    text = WORKFLOW.format(
        images=capture / "images", selector="auto, candidates: 1", looks=LOOKS, features="orb_tangent"
    )
    known = f"  known:    {{use: poses.from_model, path: {capture / 'truth' / 'poses.json'}}}\n"
    Path("pairs.yaml").write_text(text.replace("  pairs:", known + "  pairs:"))
    outcome = pano_mvs("run", "pairs.yaml", "--out", "out", "--until", "pairs")
    assert outcome.code == 0, outcome.text
    assert "nearest by the positions of 4" in outcome.flat
