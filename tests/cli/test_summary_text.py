"""What `run` prints at its end."""

from __future__ import annotations

import io
from pathlib import Path

from rich.console import Console

from pano_mvs.cli.run_command import print_scores, print_summary
from pano_mvs.report.verdict import verdict


def test_scores_of_poses_of_which_no_pair_can_be_measured() -> None:
    scores = {"poses": {"registered": 2, "of": 6, "registered_in_one_frame": 1, "auc_5_deg": 0.0}, "views": {}}
    console = Console(file=io.StringIO(), width=200)
    print_scores(scores, console)
    assert console.file.getvalue() == (
        "against the ground truth: 2 of 6 registered (1 in one frame), no pair to measure\n"
    )


def test_one_of_anything_is_not_named_as_several(tmp_path: Path) -> None:
    summary = {
        "units": {"run": 1, "cached": 0, "failed": 0}, "seconds": 1.0, "failures": [], "rejected": {}, "scores": {},
        "all_scores": {}, "notes": [], "left_over": {"a": "0"}, "files": {"b": "1"},
        "poses": {"registered": ["a"], "rejected": [], "points": 1, "scale": "none"},
    }  # fmt: skip
    console = Console(file=io.StringIO(), width=200)
    print_summary(summary, tmp_path, console, written=1, verdict=verdict({}))
    text = console.file.getvalue()
    for words in ("1 unit computed, 0 cached", "1 file of an earlier run, which this one did not write, is still",
                  "1 point; scale", "(1 file, 1 written now)"):  # fmt: skip
        assert words in text
