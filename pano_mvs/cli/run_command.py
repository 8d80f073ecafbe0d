"""Run a workflow for a person: progress, the result files, a summary."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from statistics import median
from types import FrameType
from typing import Any

from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.cli.json_events import SCHEMA, JsonEvents
from pano_mvs.cli.progress import ProgressBars
from pano_mvs.cli.session import Session, check_output
from pano_mvs.cli.streams import apart
from pano_mvs.cli.telling import INTERRUPTED, tell, tell_of_end
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.core.files import OUTPUT_MARK, set_aside
from pano_mvs.core.paths import exists, is_file
from pano_mvs.core.text import one_line, plural
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import LEAST_FREE_BYTES, Store
from pano_mvs.engine.executors.choose import make_executor
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.running.events import Observer, RunResult
from pano_mvs.engine.running.memory import bytes_from_size
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.engine.running.run import Run
from pano_mvs.report.findings import doubts_of
from pano_mvs.report.verdict import Verdict
from pano_mvs.viewer.shown_scene import is_to_see

MIN_FREE_VARIABLE = "PANO_MVS_MIN_FREE"
_SHOWN_FAILURES = 20


@dataclass(frozen=True, slots=True)
class Execution:
    """How a run is to be carried out.

    Attributes:
        executor: `serial`, `processes`, `dask`; empty for what fits the rest and this host.
        workers: units at a time; 0 for as many as there are cores for.
        threads: of each worker; 0 for an equal share of the cores.
        scheduler: address of a dask scheduler.
        as_json: whether to write events for programs to the standard output, instead of lines for people.
        min_free: room on the store's disk below which no unit is begun, such as `5GB`; empty for what
            $PANO_MVS_MIN_FREE says, else 200 MB.
        durable: whether to flush every result to the disk before going on.
    """

    executor: str = ""
    workers: int = 0
    threads: int = 0
    scheduler: str = ""
    as_json: bool = False
    min_free: str = ""
    durable: bool = False


def run_workflow(session: Session, execution: Execution = Execution()) -> int:
    """Run a workflow, write run.json and report.html, print what came out, and return the exit code."""
    check_output(session)
    _keep_what_is_not_ours(session.out)
    store = Store(session.store_root, durable=execution.durable, least_free_bytes=least_free_bytes(execution.min_free))
    executor = make_executor(store, execution.executor, workers=execution.workers, threads=execution.threads,
                             scheduler=execution.scheduler)  # fmt: skip
    stream = apart(sys.stdout)
    try:
        with interrupted_by_termination():
            if execution.as_json:
                return _run_for_programs(session, store, executor, JsonEvents(stream))
            return _run_for_people(session, store, executor, Console(file=stream))
    finally:
        executor.close()
        if stream is not sys.stdout:
            stream.close()


def least_free_bytes(size: str = "") -> int:
    """Return the bytes of `--min-free`, else of $PANO_MVS_MIN_FREE, else the default.

    Raises:
        UsageError: if it is no size.
    """
    size = size or os.environ.get(MIN_FREE_VARIABLE, "")
    try:
        return bytes_from_size(size) if size else LEAST_FREE_BYTES
    except ValueError as error:
        raise UsageError(f"--min-free (or ${MIN_FREE_VARIABLE}) {size!r}: {error}") from error


def _run_for_people(session: Session, store: Store, executor: Executor, console: Console) -> int:
    bars = ProgressBars(console, stages=len(session.workflow.stages), workers=executor.capacity)
    with bars:
        result, summary, verdict = _run(session, store, executor, bars)
    print_summary(summary, session.out, console, written=len(result.written), verdict=verdict)
    return result.exit_code


def _run_for_programs(session: Session, store: Store, executor: Executor, events: JsonEvents) -> int:
    clock = time.perf_counter()
    counts: Mapping[str, int] = {}
    told: Mapping[str, Any] = {}
    exit_code, stopped = 1, "internal error"
    events.write("run_started", schema=SCHEMA, workflow=session.workflow.name, stages=list(session.graph.order),
                 executor=executor.name, workers=executor.capacity, threads=executor.threads,
                 out=str(session.out))  # fmt: skip
    try:
        with redirect_stdout(sys.stderr):  # a plugin that lists its items does so in this process
            result, summary, verdict = _run(session, store, executor, events)
        exit_code, stopped, counts = result.exit_code, result.stopped, summary["units"]
        told = {"verdict": asdict(verdict), "doubts": doubts_of(summary)}
    except PanoMvsError as error:
        exit_code, stopped = error.exit_code, str(error)
        raise
    except KeyboardInterrupt:
        exit_code, stopped = INTERRUPTED, "interrupted"
        raise
    finally:
        events.write("run_finished", exit_code=exit_code, stopped=stopped,
                     **{name: counts.get(name, 0) for name in ("run", "cached", "failed", "blocked")},
                     seconds=round(time.perf_counter() - clock, 3), out=str(session.out), **told)  # fmt: skip
    return exit_code


def _run(
    session: Session, store: Store, executor: Executor, observer: Observer
) -> tuple[RunResult, dict[str, Any], Verdict]:
    """Run, and write what there is to say of it into the output folder."""
    started, clock = datetime.now(UTC), time.perf_counter()
    run = Run(session.workflow, session.graph, store, session.out, observer=observer, executor=executor,
              demands=session.demands)  # fmt: skip
    with output_lock(session.out):
        return _run_alone(session, run, started, clock)


def _run_alone(
    session: Session, run: Run, started: datetime, clock: float
) -> tuple[RunResult, dict[str, Any], Verdict]:
    """Run while no other run writes into the folder."""
    earlier = earlier_files(session.out)
    while True:
        try:
            result = run.execute(earlier_files=earlier)
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            tell_of_end(run, error, partial(tell, session.out, run, started=started, clock=clock))
            raise
        try:
            summary, verdict = tell(session.out, run, started=started, clock=clock)
            break
        except DamagedBlobError as error:  # found only now; it has been removed, so a further round computes it
            run.observer.warn(str(error))
    return result, summary, verdict


@contextmanager
def interrupted_by_termination() -> Iterator[None]:
    """Let a request to terminate (SIGTERM) and the end of the terminal (SIGHUP) end a run as an interrupt does.

    A terminal that closes sends SIGHUP more than once: only the first counts. Under nohup it is ignored, as is wanted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only a main thread is told
        return

    hangup = getattr(signal, "SIGHUP", None)
    ends = [signal.SIGTERM, *([hangup] if hangup and signal.getsignal(hangup) is not signal.SIG_IGN else [])]

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        if hangup is not None:
            signal.signal(hangup, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ends}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _keep_what_is_not_ours(out: Path) -> None:
    """Rename files that we are about to write where no run of ours has written before."""
    if not exists(out / OUTPUT_MARK):
        for path in (out / "run.json", out / "report.html"):
            if is_file(path):
                set_aside(path)


def earlier_files(out: Path) -> dict[str, str]:
    """Return the files, with their digests, that an earlier run wrote into a folder."""
    try:
        last = json.loads((out / "run.json").read_bytes())
        files = {**last["files"], **last.get("left_over", {})}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {str(name): str(digest) for name, digest in files.items()}


def print_summary(summary: Mapping[str, Any], out: Path, console: Console, *, written: int, verdict: Verdict) -> None:
    """Print where the results are and how good they are known to be."""
    units = summary["units"]
    failed = f", {units['failed']} failed" if units["failed"] else ""
    cached = " (nothing to compute)" if not units["run"] and not units["failed"] else ""
    counts = f"{units['run']} {plural(units['run'], 'unit')} computed, {units['cached']} cached{failed}"
    console.print(f"\n{counts} in {summary['seconds']:.1f} s{cached}", highlight=False)
    _print_failures(summary, console)
    _print_poses(summary, console)
    print_scores(summary["scores"], console)
    _print_comparison(summary["all_scores"], console)
    for note in summary["notes"]:
        console.print(f"note: {escape(note)}", highlight=False, soft_wrap=True)
    if summary["left_over"]:
        count = len(summary["left_over"])
        console.print(
            f"{count} {plural(count, 'file')} of an earlier run, which this one did not write, "
            f"{plural(count, 'is', 'are')} still there", highlight=False
        )  # fmt: skip
    _print_verdict(verdict, console)
    look = f", or look around with pano-mvs view {escape(shlex.quote(str(out)))}" if is_to_see(summary["files"]) else ""
    console.print(
        f"results in {escape(str(out))} ({len(summary['files'])} {plural(len(summary['files']), 'file')}, {written} "
        f"written now): open report.html{look}",
        highlight=False,
        soft_wrap=True,
    )


def _print_failures(summary: Mapping[str, Any], console: Console) -> None:
    causes = summary["failures"]
    for failure in causes[:_SHOWN_FAILURES]:
        label = one_line(f"{failure['stage']}:{failure['item']}" if failure["item"] else failure["stage"])
        text = f"{label}: {failure['cause']} — {failure['consequence']}"
        console.print(f"[red]failed:[/] {escape(text)}", highlight=False, soft_wrap=True)
        if failure["log"]:
            console.print(f"  what it printed is in {escape(failure['log'])}", highlight=False, soft_wrap=True)
    if len(causes) > _SHOWN_FAILURES:
        console.print(f"… and {len(causes) - _SHOWN_FAILURES} more, all in run.json", highlight=False)
    for image, rejected in summary["rejected"].items():
        text = f"{one_line(image)}: {rejected['reason']}"
        console.print(f"[yellow]left out:[/] {escape(text)}", highlight=False, soft_wrap=True)


def _print_poses(summary: Mapping[str, Any], console: Console) -> None:
    poses = summary["poses"]
    if poses:
        total = len(poses["registered"]) + len(poses["rejected"])
        console.print(f"poses: {len(poses['registered'])} of {total} registered, {poses['points']} "
                      f"{plural(poses['points'], 'point')}; scale: {escape(poses['scale'])}",
                      highlight=False)  # fmt: skip


def _print_verdict(verdict: Verdict, console: Console) -> None:
    """Print whether the result can be relied on, as the report says it, and what is wrong or doubtful."""
    if verdict.judgement:
        console.print(f"[{_COLORS[verdict.mood]}]{escape(verdict.judgement)}[/]", highlight=False, soft_wrap=True)
    for finding in verdict.findings:
        if finding.mood in _MARKS:
            text = (
                f"[{_COLORS[finding.mood]}]{_MARKS[finding.mood]}:[/] {escape(finding.text)} {escape(finding.remedy)}"
            )
            console.print(text.rstrip(), highlight=False, soft_wrap=True)


_COLORS = {"good": "green", "fair": "yellow", "bad": "red"}
_MARKS = {"fair": "doubtful", "bad": "bad"}


def print_scores(scores: Mapping[str, Any], console: Console) -> None:
    """Print pose scores in a line and range scores in a table."""
    poses = scores.get("poses")
    if poses:
        together = poses.get("registered_in_one_frame")
        in_one_frame = "" if together is None else f" ({together} in one frame)"
        error_deg = poses.get("median_pair_error_deg")
        measured = "no pair to measure" if error_deg is None else f"median pair error {error_deg:.3f}°"
        text = f"{poses['registered']} of {poses['of']} registered{in_one_frame}, {measured}"
        if "scale_ratio_error_max" in poses:
            text += f", translation scale ratios within {100 * poses['scale_ratio_error_max']:.2f} %"
        console.print(f"against the ground truth: {text}", highlight=False)
    if not scores.get("views"):
        return
    table = Table("view", *_SHOWN_SCORES.values(), caption=_IN_BRACKETS)
    for view, values in scores["views"].items():
        table.add_row(escape(view), *(_beside_constant(values, name) for name in _SHOWN_SCORES))
    console.print(table)


def _print_comparison(all_scores: Mapping[str, Any], console: Console) -> None:
    """Print, where several branches are scored, the medians over their views side by side."""
    if len(all_scores) < 2:
        return
    table = Table("median over views", *_SHOWN_SCORES.values(), caption=_IN_BRACKETS)
    for stage, scores in all_scores.items():
        views = scores["views"].values()
        names = {name for view in views for name in view}
        found = {name: [view[name] for view in views if view.get(name) is not None] for name in names}
        middle = {name: median(values) for name, values in found.items() if values}
        table.add_row(escape(stage), *(_beside_constant(middle, name) for name in _SHOWN_SCORES))
    console.print(table)


_IN_BRACKETS = "in brackets: the best of all constant ranges"
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


def _beside_constant(values: Mapping[str, float], name: str) -> str:
    constant = values.get(f"best_constant_{name}")
    return _shown(values.get(name)) + ("" if constant is None else f" ({_shown(constant)})")


def _shown(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:z.3g}" if abs(value) < 1 else f"{value:.2f}"
