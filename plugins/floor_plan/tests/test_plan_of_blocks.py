"""The floor plan of a capture that was merged from blocks."""

from __future__ import annotations

import json
from pathlib import Path

from pano_mvs.io.ply import read_ply, write_ply
from pano_mvs.results.records import StageOutcome
from pano_mvs.scene.upright import z_up_from_world
from pano_mvs.session.merging.merge import merge_outputs
from tests.session.merging.test_merge import with_exports


def test_the_plan_is_made_of_the_whole_capture(tmp_path: Path) -> None:
    plan = StageOutcome(name="plan", use="export.floor_plan", params={"formats": ["svg"]})
    merged = merge_outputs(with_exports(tmp_path, plan), tmp_path / "merged")
    about = json.loads((tmp_path / "merged/floor_plan/floor_plan.json").read_text())
    assert sum(len(storey["cameras"]) for storey in about["storeys"]) == 30
    assert "floor_plan/floor_plan.json" in merged.summary.files


def test_the_plan_needs_no_numbers_of_views_in_the_files_of_blocks(tmp_path: Path) -> None:
    """By default, export.ply writes none."""
    outs = with_exports(tmp_path, StageOutcome(name="plan", use="export.floor_plan"))
    for out in outs:
        write_ply(out / "cloud.ply", read_ply(out / "cloud.ply"), file_from_world=z_up_from_world())
    assert "floor_plan/floor_plan.json" in merge_outputs(outs, tmp_path / "merged").summary.files


def test_two_plans_are_not_mixed(tmp_path: Path) -> None:
    plans = [StageOutcome(name=f"plan_{n}", use="export.floor_plan", params={"width_px": 100 * n}) for n in (3, 4)]
    merged = merge_outputs(with_exports(tmp_path, *plans), tmp_path / "merged")
    about = json.loads((tmp_path / "merged/floor_plan/floor_plan.json").read_text())
    assert about["storeys"][0]["plan_size_px"][0] <= 300
    assert any("another export has written floor_plan/" in note for note in merged.summary.notes)
