"""Run a workflow: from a session to the results in the output folder, in the order of a run."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pano_mvs.algorithms.filters.consistency import Agreement, evidence_of_views
from pano_mvs.algorithms.poses.verification.belief.doubts import with_later_evidence
from pano_mvs.core.errors import InputError, PanoMvsError, UsageError
from pano_mvs.core.files import OUTPUT_MARK, set_aside
from pano_mvs.core.memory import bytes_from_size
from pano_mvs.core.paths import exists, is_file
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import MIN_FREE_BYTES, Store
from pano_mvs.engine.executors.choose import ExecutorRequest, make_executor
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.running.events import Warned, ignore
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.engine.running.run import Run
from pano_mvs.report.page import gather_report, write_page
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import FAILED_ITEMS, INTERRUPTED, RUN_JSON, RunSummary
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.session.code_listing import write_code_listing
from pano_mvs.session.observers import Observers
from pano_mvs.session.planning import forecast_run, remember_report
from pano_mvs.session.progress import EventLog, Progress, RunFinished, RunStarted
from pano_mvs.session.session import Session, check_output
from pano_mvs.session.summarise import chain_of, latest, summarise
from pano_mvs.session.time_estimator import EventObserver

MIN_FREE_VARIABLE = "PANO_MVS_MIN_FREE"


@dataclass(frozen=True, slots=True)
class Execution:
    """How the units of a run are computed."""

    executor: str = ""  # name of a built-in executor or of a plugin's; empty to choose by the other settings
    workers: int = 0  # number of units at a time; 0 for one per core, if memory permits
    threads: int = 0  # of each worker; 0 for an equal share of the cores
    # of the executor: the option of `pano-mvs run` without its dashes to its value, such as `queue` to a file
    options: Mapping[str, str] = field(default_factory=dict)
    # free space on the cache's disk below which no unit is started, such as `5GB`; empty for the value of
    # $PANO_MVS_MIN_FREE, or else 200 MB
    min_free: str = ""
    durable: bool = False  # whether to flush every result to disk
    observers: Observers | None = None  # receive the events of the run, as `observing` makes them

    @property
    def request(self) -> ExecutorRequest:
        """What the run asks of its executor."""
        return ExecutorRequest(self.executor, self.workers, self.threads, self.options)

    def observed(self, progress: Progress) -> Progress:
        """Return a callback that passes events on, and to the observers."""
        return progress if self.observers is None else self.observers.beside(progress)


def _check_not_merged(out: Path) -> None:
    """Check that a run does not replace the run.json and the report of merged blocks."""
    try:
        merged = RunSummary.read(out).merged
    except InputError:
        return
    if merged is not None:
        raise UsageError(
            f"--out {out}: holds results that were merged from {len(merged.blocks)} blocks, of which a run would "
            "replace a part. Leave out --block-size 0, or choose another folder"
        )


def run_session(session: Session, execution: Execution = Execution(), progress: Progress = ignore) -> RunOutput:
    """Run an open session, all images at once; see `pano_mvs.run`."""
    check_output(session)
    _check_not_merged(session.out)
    if not exists(session.out / OUTPUT_MARK):
        for path in (session.out / RUN_JSON, session.out / "report.html"):
            if is_file(path):
                set_aside(path)
    min_free = min_free_bytes(execution.min_free)
    store = Store(session.store_root, durable=execution.durable, min_free_bytes=min_free)
    executor = make_executor(store, execution.request)
    try:
        log = EventLog(progress)
        return _run_and_report(session, store, executor, log=log, report=execution.observed(log))
    finally:
        executor.close()


def _run_and_report(
    session: Session, store: Store, executor: Executor, *, log: EventLog, report: Progress
) -> RunOutput:
    """Run, and report the first and the last event.

    Args:
        log: writes events into the output folder once it is open.
        report: passes events on to the log, and to observers.
    """
    clock = time.perf_counter()
    observer = EventObserver(report, executor=executor)
    observer(
        RunStarted(
            workflow=session.workflow.name,
            stages=tuple(session.graph.order),
            executor=executor.name,
            workers=executor.capacity,
            threads=executor.threads,
            out=session.out,
            cache=store.root.absolute(),
            groups={name: stage.group for name, stage in session.workflow.stages.items() if stage.group},
        )
    )
    end = RunFinished(exit_code=1, stopped="internal error", out=session.out)
    started, run = datetime.now(UTC), None
    try:
        run = Run(
            session.workflow,
            session.graph,
            store,
            out=session.out,
            observer=observer,
            executor=executor,
            options=session.run_options,
        )
        with output_lock(session.out):
            log.open(session.out)
            for reason in session.workflow.warnings:
                observer(Warned(reason))
            if (forecast := forecast_run(run)) is not None:
                observer(forecast)
            summary, values = _execute(run, started, clock)
        end = replace(
            end,
            exit_code=summary.exit_code,
            stopped=summary.stopped,
            verdict=summary.verdict,
            doubts=dict(summary.doubtful_images),
        )
        return RunOutput(session.out, summary, values, written=tuple(run.result.written))
    except PanoMvsError as error:
        end = replace(end, exit_code=error.exit_code, stopped=str(error))
        raise
    except KeyboardInterrupt:
        end = replace(end, exit_code=INTERRUPTED, stopped="interrupted")
        raise
    finally:
        units: dict[str, Any] = {}
        if run is not None:
            units |= run.result.units
        report(replace(end, **units, seconds=round(time.perf_counter() - clock, 3)))


def _execute(run: Run, started: datetime, clock: float) -> tuple[RunSummary, StoredValues]:
    """Compute, then write summary and report; recompute damaged results that only the report reads."""
    earlier = earlier_files(run.out)
    repairs = 0
    while True:
        try:
            run.execute(earlier_files=earlier)
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            write_outputs_after_error(run, error, started=started, clock=clock)
            raise
        try:
            began = time.perf_counter()
            outputs = write_outputs(run, started=started, clock=clock)
            remember_report(run, time.perf_counter() - began)
            return outputs
        except DamagedBlobError as error:  # it has been removed, so another round computes it
            repairs += 1
            if repairs > 3:  # more damage than this suggests a failing disk
                raise
            run.observer(Warned(str(error)))


def earlier_files(out: Path) -> dict[str, str]:
    """Return the files that an earlier run wrote into a folder, with their digests; empty if unknown."""
    try:
        last = json.loads((out / RUN_JSON).read_bytes())
        files = {**last["files"], **last.get("left_over", {})}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {str(name): str(digest) for name, digest in files.items()}


def write_outputs(run: Run, *, started: datetime, clock: float) -> tuple[RunSummary, StoredValues]:
    """Judge a run and write its run.json and its report; return the summary and the values behind it.

    Args:
        run: after `execute`, also if it raised.
        clock: the same by `time.perf_counter`.

    Raises:
        StoreError: if a file cannot be written; run.json is written first.
    """
    poses, stage = _judged_poses(run)
    if poses is not None and stage:
        for image in poses.names:
            doubt = poses.doubts.get(image)
            if doubt and run.result.doubts.get(image, ("", ""))[1] != doubt:
                run.result.doubts[image] = stage, doubt
    if poses is not None:
        _admit_placed(run, {*poses.names})
    if run.result.exit_code in (0, FAILED_ITEMS) and not run.result.stopped:
        run.result.exit_code = FAILED_ITEMS if run.result.doubts or not run.result.complete else 0
    summary = summarise(run, poses, started=started, seconds=time.perf_counter() - clock)
    values = StoredValues.of_run(run, summary.results)
    try:
        report = gather_report(run.out, summary, values)
        summary = summary.model_copy(update={"verdict": report.verdict})
    finally:
        summary.write(run.out)
    write_page(run.out, summary, report)
    write_code_listing(run.out, run.workflow)
    return summary, values


def _admit_placed(run: Run, names: Collection[str]) -> None:
    """Forget that a stage of poses left out images that a later one placed."""
    stages = chain_of(run.workflow, run.graph, Poses)
    for image, (stage, _) in list(run.result.rejected.items()):
        if image in names and stage in stages:
            del run.result.rejected[image]


def write_outputs_after_error(run: Run, error: BaseException, *, started: datetime, clock: float) -> None:
    """Write run.json and the report of a run that raised an error; if it did nothing, the earlier ones stay."""
    units = run.result.units
    if not units["run"] + units["cached"] + units["failed"]:
        return
    interrupted = isinstance(error, KeyboardInterrupt)
    stopped = f"sys.exit({error.code})" if isinstance(error, SystemExit) else str(error)
    run.result.stopped = "interrupted" if interrupted else stopped
    run.result.exit_code = INTERRUPTED if interrupted else error.exit_code if isinstance(error, PanoMvsError) else 1
    try:
        write_outputs(run, started=started, clock=clock)
    except (PanoMvsError, OSError) as second:
        error.add_note(f"The report could not be written either: {second}")


_FIGURES = tuple(Agreement.__dataclass_fields__)


def _judged_poses(run: Run) -> tuple[Poses | None, str]:
    """Return the poses of a run, judged by the last range maps that were compared, too, and the stage of these."""
    poses = latest(run, Poses)
    metrics = {summary.stage: summary.unit_metrics for summary in run.result.stages}
    for name in reversed(chain_of(run.workflow, run.graph, RangeMap)):
        agreements = {
            view: Agreement(*(values[figure] for figure in _FIGURES))
            for view, values in metrics.get(name, {}).items()
            if all(figure in values for figure in _FIGURES)
        }
        if agreements and poses is not None:
            found: dict[str, tuple[float, str]] = {}
            for group in split_groups(poses):
                found |= evidence_of_views(agreements, dict(zip(group.names, group.centers, strict=True)))
            return with_later_evidence(poses, found), name
    return poses, ""


def min_free_bytes(size: str = "") -> int:
    """Return the bytes of `--min-free`, else of $PANO_MVS_MIN_FREE, else the default.

    Raises:
        UsageError: if it is not a size.
    """
    size = size or os.environ.get(MIN_FREE_VARIABLE, "")
    try:
        return bytes_from_size(size) if size else MIN_FREE_BYTES
    except ValueError as error:
        raise UsageError(f"--min-free (or ${MIN_FREE_VARIABLE}) {size!r}: {error}") from error
