"""What `run` prints at its end."""

from __future__ import annotations

import io

from rich.console import Console

from pano_mvs.cli.run_command import print_scores


def test_scores_of_poses_of_which_no_pair_can_be_measured() -> None:
    scores = {"poses": {"registered": 2, "of": 6, "registered_in_one_frame": 1, "auc_5_deg": 0.0}, "views": {}}
    console = Console(file=io.StringIO(), width=200)
    print_scores(scores, console)
    assert console.file.getvalue() == (
        "against the ground truth: 2 of 6 registered (1 in one frame), no pair to measure\n"
    )
