"""The summary that `pano-mvs run` prints."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.commands import COMMANDS
from pano_mvs.cli.console import Console
from pano_mvs.core.paths import resolved
from pano_mvs.core.text import one_line, plural
from pano_mvs.results.figures import score_tables, side_by_side
from pano_mvs.results.records import ScoresSummary, Verdict
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.summary import RunSummary, cache_of
from pano_mvs.session.session import Session, run_command

_SHOWN_FAILURES = 20


def print_summary(output: RunOutput, console: Console, *, following: Sequence[str] = ()) -> None:
    """Print the summary of a run: counts, failures, scores, the verdict and its reasons, and what to type next.

    Args:
        following: the commands to type next; see `next_commands`.
    """
    summary = output.summary
    units = summary.units
    failed = f", {units.failed} failed" if units.failed else ""
    is_idle = not (units.run or units.failed or summary.stopped)
    cached = " (nothing to compute)" if is_idle else ""
    counts = f"{units.run} {plural(units.run, 'unit')} computed, {units.cached} cached{failed}"
    console.print(f"\n{counts} in {summary.seconds or 0:.1f} s{cached}", highlight=False)
    _print_failures(summary, console)
    if poses := summary.poses:
        total = len(poses.registered) + len(poses.rejected)
        points = f"{poses.points} {plural(poses.points, 'point')}"
        text = f"poses: {len(poses.registered)} of {total} registered, {points}; scale: {poses.scale}"
        console.print(escape(text), highlight=False)
    print_scores(summary.scores, console)
    all_scores = [(stage, score_tables(each, only=list(_SHOWN_SCORES))) for stage, each in summary.all_scores.items()]
    if rows := side_by_side(all_scores)["rows"]:
        _print_table("median over views", rows, console)
    for note in summary.notes:
        console.say(f"note: {escape(note)}")
    if summary.left_over:
        count = len(summary.left_over)
        text = f"{count} {plural(count, 'file')} of an earlier run, which this run did not write,"
        console.print(f"{text} {plural(count, 'is', 'are')} still there", highlight=False)
    print_verdict(output.verdict, console)
    count = len(summary.files)
    files = f"{count} {plural(count, 'file')}, {len(output.written)} written now"
    report = f"; open {escape(str(output.out / 'report.html'))} in a browser"
    console.say(f"results in {escape(str(output.out))} ({files}){report}")
    print_next(following, console)


def print_next(commands: Sequence[str], console: Console) -> None:
    """Print the commands to type next, if there are any."""
    if commands:
        console.print("next:", highlight=False)
    for command in commands:
        console.say(f"  {escape(command)}")


def next_commands(output: RunOutput, session: Session) -> list[str]:
    """Return the commands to type after a run, which can be pasted in the current folder.

    A run that has failed units, or that ended early, can be repeated once the cause is removed. A partial run can be
    continued with the rest. Results can be looked at and sent.
    """
    summary, out = output.summary, str(output.out)
    commands = []
    if summary.stopped or summary.failures or session.run_options.is_partial:
        commands.append(run_command(session))
    if has_scene(summary) and "view" in COMMANDS.names():
        commands.append(shlex.join(["pano-mvs", "view", out]))
    if is_to_share(summary) and "share" in COMMANDS.names():
        words = ["pano-mvs", "share", out, "--to", f"{out}_page"]
        if resolved(cache_of(summary)) != resolved(Path(summary.cache)):
            words += ["--cache", summary.cache]
        commands.append(shlex.join(words))
    return commands


def has_scene(summary: RunSummary) -> bool:
    """Return whether a run has written a cloud, a mesh or cameras, which viewers can show."""
    files = (PurePosixPath(name) for name in summary.files)
    return any(file.name in ("cloud.ply", "mesh.ply") or file.is_relative_to("colmap/sparse/0") for file in files)


def is_to_share(summary: RunSummary) -> bool:
    """Return whether a run has results that a page can show."""
    return bool(summary.cloud.points or summary.views)


def _print_failures(summary: RunSummary, console: Console) -> None:
    causes = summary.failures
    for failure in causes[:_SHOWN_FAILURES]:
        text = f"{one_line(failure.label)}: {failure.cause} — {failure.consequence}"
        console.say(f"[red]failed:[/] {escape(text)}")
        if failure.log:
            console.say(f"  log: {escape(failure.log)}")
    if len(causes) > _SHOWN_FAILURES:
        console.print(f"… and {len(causes) - _SHOWN_FAILURES} more, all in run.json", highlight=False)
    for image, rejected in summary.rejected.items():
        text = f"{one_line(image)}: {rejected.reason}"
        console.say(f"[yellow]left out:[/] {escape(text)}")


def print_verdict(verdict: Verdict, console: Console) -> None:
    """Print the verdict of the report and its findings."""
    if verdict.judgement:
        console.say(f"[{_COLORS[verdict.mood]}]{escape(verdict.judgement)}[/]")
    for finding in verdict.findings:
        if finding.mood in _MARKS:
            text = (
                f"[{_COLORS[finding.mood]}]{_MARKS[finding.mood]}:[/] {escape(finding.text)} {escape(finding.remedy)}"
            )
            console.say(text.rstrip())


_COLORS = {"good": "green", "fair": "yellow", "bad": "red"}
_MARKS = {"fair": "doubtful", "bad": "bad"}


def print_scores(scores: ScoresSummary, console: Console) -> None:
    """Print pose scores in a line and range scores in a table."""
    poses = scores.poses
    if poses:
        together = poses.get("registered_in_one_frame")
        in_one_frame = "" if together is None else f" ({together} in one frame)"
        error_deg = poses.get("median_pair_error_deg")
        measured = "no pair to measure" if error_deg is None else f"median pair error {error_deg:.3f}°"
        text = f"{poses['registered']} of {poses['of']} registered{in_one_frame}, {measured}"
        if "scale_ratio_error_max" in poses:
            text += f", translation scale ratios within {100 * poses['scale_ratio_error_max']:.2f} %"
        console.print(f"against the ground truth: {text}", highlight=False)
    if scores.views:
        _print_table("view", score_tables(scores, only=list(_SHOWN_SCORES))["views"], console)


def _print_table(name: str, rows: Sequence[tuple[str, Sequence[str]]], console: Console) -> None:
    table = Table(name, *_SHOWN_SCORES.values(), caption="in brackets: the best of all constant ranges")
    for item, cells in rows:
        table.add_row(escape(item), *cells)
    console.print(table)


_SHOWN_SCORES = {
    "psnr_db": "PSNR dB",
    "w_mae": "MAE",
    "w_delta_105": "δ<1.05",
    "completeness": "complete",
    "ause": "AUSE",
}
"""Score to the heading under which it is printed; MAE and δ are weighted by solid angle.

AUSE is the area between the sparsification curve of the confidence and that of the true errors.
"""
