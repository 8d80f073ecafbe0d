"""`pano-mvs vary` on rendered panoramas of a room with its truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import pano_mvs as pano_mvs_package
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import SMALL, Command
from tests.synthetic.capture_files import write_capture


@pytest.mark.slow
def test_a_setting_is_varied_over_a_room(tmp_path: Path, pano_mvs: Command) -> None:
    room = tmp_path / "room"
    write_capture(room, default_room(), capture_poses(3, spread=0.4), size_hw=(112, 224))
    words = ("vary", "quickstart", "--images", room / "images", "--set", f"scores.truth={room / 'truth'}")
    small = (SMALL[2], SMALL[3])  # without the planes
    grid = ("--set", "depth.planes=8,32", "--best", "scores.w_mae")
    plan = pano_mvs(*words, *small, *grid, "--out", "v", "--cache", "cache", "--dry-run")
    assert plan.code == 0, plan.text
    done = pano_mvs(*words, *small, *grid, "--out", "v", "--cache", "cache")
    assert done.code in (0, 3), done.text
    found = json.loads(Path("v/vary.json").read_text())
    names = [each["name"] for each in found["combinations"]]
    assert names == ["planes=8", "planes=32"]
    assert {"scores.median_pair_error_deg", "scores.w_mae", "seconds"} <= set(found["metrics"])
    errors = {each["name"]: each["metrics"]["scores.w_mae"]["mean"] for each in found["combinations"]}
    assert errors["planes=32"] < errors["planes=8"]
    for run in found["runs"]:
        assert (Path("v") / run["out"] / "report.html").is_file()
    # The same name means the same figure in both tables.
    listed = {row.out.name: row.metrics for row in pano_mvs_package.runs("v", metrics=["scores.w_mae"]).rows}
    assert {name: row["scores.w_mae"] for name, row in listed.items()} == pytest.approx(errors)
    # The stages up to the poses do not depend on the sweep: they are computed by the first run alone.
    first, *others = found["runs"]
    poses = {
        stage["name"]: stage["run"]
        for run in others
        for stage in json.loads((Path("v") / run["out"] / "run.json").read_text())["stages"]
        if stage["name"] in ("images", "features", "matches", "poses")
    }
    assert poses == {"images": 0, "features": 0, "matches": 0, "poses": 0}
    assert first["units"]["run"] > max(run["units"]["run"] for run in others)
    assert all(each["metrics"]["seconds"]["mean"] > 0.1 for each in found["combinations"])
    # The seed is not known to matter: the first is not called the best.
    assert "--seeds 3 measures it" in done.flat
    again = pano_mvs(*words, *small, *grid, "--out", "v", "--cache", "cache")
    assert "\n0 units computed; results in v" in again.text
