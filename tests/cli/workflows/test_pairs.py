"""Pair selectors inside a workflow, on a tiny rendered capture."""

from __future__ import annotations

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
