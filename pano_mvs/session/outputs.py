"""Write run.json and the report of a run into its output folder, however it ended."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from pano_mvs.algorithms.filters.consistency import Agreement, view_doubts
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.files import OUTPUT_MARK, set_aside
from pano_mvs.core.paths import exists, is_file
from pano_mvs.engine.running.run import Run
from pano_mvs.report.page import gather_report, write_page
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RUN_JSON, RunSummary
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.session.final_stages import chain_of, latest
from pano_mvs.session.sudden_exit import exit_text
from pano_mvs.session.summarise import summarise

INTERRUPTED = 130
"""The exit code of a run that was interrupted."""


def set_aside_foreign_files(out: Path) -> None:
    """Rename files that the run is about to write, unless an earlier run wrote into the folder."""
    if not exists(out / OUTPUT_MARK):
        for path in (out / RUN_JSON, out / "report.html"):
            if is_file(path):
                set_aside(path)


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
        started: when it began.
        clock: the same by `time.perf_counter`.

    Raises:
        StoreError: if a file cannot be written; run.json is written first.
    """
    add_dense_doubts(run)
    summary = summarise(run, started=started, seconds=time.perf_counter() - clock)
    values = StoredValues.of_run(run, summary.results)
    try:
        report = gather_report(run.out, summary, values)
        summary = summary.model_copy(update={"verdict": report.verdict})
    finally:
        summary.write(run.out)
    write_page(run.out, summary, report)
    return summary, values


def write_outputs_after_error(run: Run, error: BaseException, *, started: datetime, clock: float) -> None:
    """Write run.json and the report of a run that raised an error; if it did nothing, the earlier ones stay."""
    if not any(stage.run + stage.cached + stage.failed for stage in run.result.stages):
        return
    interrupted = isinstance(error, KeyboardInterrupt)
    run.result.stopped = "interrupted" if interrupted else _reason(error)
    run.result.exit_code = INTERRUPTED if interrupted else error.exit_code if isinstance(error, PanoMvsError) else 1
    try:
        write_outputs(run, started=started, clock=clock)
    except (PanoMvsError, OSError) as second:
        error.add_note(f"The report could not be written either: {second}")


def _reason(error: BaseException) -> str:
    return exit_text(error) if isinstance(error, SystemExit) else str(error)


_FIGURES = tuple(Agreement.__dataclass_fields__)


def add_dense_doubts(run: Run) -> None:
    """Mark views that other views contradict as doubtful, so that the run ends with exit code 3.

    The figures of `Agreement` are used from the last stage of the range maps that reports them;
    filters.consistency does. Cameras that are doubted already keep their reason.
    """
    poses = latest(run, Poses)
    stage = _compared_stage(run)
    if poses is not None and stage:
        name, figures = stage
        groups, centers = poses.groups, poses.centers
        for group in range(len(poses.worlds)):
            inside = {image: centers[idx] for idx, image in enumerate(poses.names) if groups[idx] == group}
            for image, reason in view_doubts(figures, inside).items():
                run.result.doubts.setdefault(image, (name, reason))
    if run.result.doubts and run.result.exit_code == 0:
        run.result.exit_code = 3


def _compared_stage(run: Run) -> tuple[str, Mapping[str, Agreement]] | None:
    """Return the last stage of the range maps that compared the views, and what it found of each."""
    metrics = {summary.name: summary.unit_metrics for summary in run.result.stages}
    for name in reversed(chain_of(run.workflow, run.graph, RangeMap)):
        found = {
            view: Agreement(*(values[figure] for figure in _FIGURES))
            for view, values in metrics.get(name, {}).items()
            if all(figure in values for figure in _FIGURES)
        }
        if found:
            return name, found
    return None
