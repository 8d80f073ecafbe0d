"""What `run` prints at its end."""

from __future__ import annotations

import io
from pathlib import Path

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_scores, print_summary
from pano_mvs.results.records import ScoresSummary
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary


def test_scores_of_poses_of_which_no_pair_can_be_measured() -> None:
    scores = ScoresSummary(poses={"registered": 2, "of": 6, "registered_in_one_frame": 1, "auc_5_deg": 0.0})
    stream = io.StringIO()
    print_scores(scores, Console(file=stream, width=200))
    assert stream.getvalue() == "against the ground truth: 2 of 6 registered (1 in one frame), no pair to measure\n"


def test_one_of_anything_is_not_named_as_several(tmp_path: Path) -> None:
    summary = RunSummary.from_json(
        {
            "units": {"run": 1},
            "seconds": 1.0,
            "left_over": {"a": "0"},
            "files": {"b": "1"},
            "poses": {"registered": ["a"], "points": 1, "scale": "none"},
        }
    )
    stream = io.StringIO()
    print_summary(RunOutput(tmp_path, summary, StoredValues(), written=("b",)), Console(file=stream, width=200))
    for words in (
        "1 unit computed, 0 cached",
        "1 file of an earlier run, which this run did not write, is still",
        "1 point; scale",
        "(1 file, 1 written now)",
    ):
        assert words in stream.getvalue()
