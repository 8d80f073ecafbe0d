"""Slanted planes between a sweep and the consistency check, from pictures on disk to range maps."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json

WORKFLOW = """\
pano_mvs: 1
stages:
  images:   {use: source.folder, path: capture/images}
  poses:    {use: poses.from_model, path: capture/truth/poses.json}
  views:    {use: views.nearest, sources: 3}
  depth:    {use: depth.sweep, planes: 32, near: 0.5, far: 6}
  refined:  {use: depth.patchmatch, rounds: 2}
  checked:  {use: filters.consistency}
  truth:    {use: evaluate.truth, truth: capture/truth}
"""


@pytest.mark.slow
def test_refinement_makes_more_pixels_consistent_and_all_more_precise(capture: Path, pano_mvs: Command) -> None:
    path = capture.parent / "planes.yaml"
    scores = {}
    for name, text in {"with": WORKFLOW, "without": WORKFLOW.replace("  refined:", "  # ")}.items():
        path.write_text(text)
        out = capture.parent / name
        outcome = pano_mvs("run", path, "--out", out)
        assert outcome.code == 0, outcome.text
        scores[name] = run_json(out)
    for view in scores["with"]["views"]:
        name = view["name"]
        other = next(v for v in scores["without"]["views"] if v["name"] == name)
        assert view["consistent"] > other["consistent"]
        after, before = (scores[way]["scores"]["views"][name]["median_relative_error"] for way in ("with", "without"))
        assert after < 0.6 * before
