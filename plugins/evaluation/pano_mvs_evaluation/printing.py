"""Display of evaluations in the terminal."""

from __future__ import annotations

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_scores
from pano_mvs.results.records import ScoresSummary
from pano_mvs_evaluation.capture import RunEvaluation
from pano_mvs_evaluation.ranges.tables import depth_summary
from pano_mvs_evaluation.tables import Summary, TextTable


def print_summary(summary: Summary, console: Console) -> None:
    """Print lines and tables."""
    for part in summary:
        if isinstance(part, TextTable):
            console.print(_rich_table(part))
        else:
            console.say(escape(part))


def print_run(evaluation: RunEvaluation, console: Console) -> None:
    """Print all scores of a run, and why some are missing."""
    if (poses := evaluation.poses) is not None:
        print_scores(ScoresSummary(poses=poses.poses), console)
        if "registered_in_one_frame" in poses.poses:
            console.say(escape(poses.notes[0]))
    if evaluation.depth is not None:
        print_summary(depth_summary(evaluation.depth), console)
    if evaluation.cloud is not None:
        print_summary(evaluation.cloud.summary(), console)
    for result, reason in evaluation.not_compared.items():
        console.say(escape(f"{result}: not compared, {reason}"))


def _rich_table(text: TextTable) -> Table:
    if not text.baselines:
        table = Table(*text.headings)
        for row in text.rows:
            table.add_row(*map(escape, row))
        return table
    table = Table(*text.headings, box=SIMPLE, collapse_padding=True)
    for row, baseline in zip(text.rows, text.baselines, strict=True):
        table.add_row(*map(escape, row))
        table.add_row(*map(escape, baseline), style="dim", end_section=True)
    return table
