"""Write what there is to say of a run into its output folder, however it ended: run.json and the report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.files import replacing
from pano_mvs.engine.running.run import Run
from pano_mvs.report.page import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.verdict import Verdict
from pano_mvs.session.dense_doubts import add_dense_doubts
from pano_mvs.session.sudden_exit import exit_text
from pano_mvs.session.summarise import summarise

INTERRUPTED = 130
"""The exit code of a run that was interrupted."""


def tell(out: Path, run: Run, *, started: datetime, clock: float) -> tuple[dict[str, Any], Verdict]:
    """Judge the run, write run.json and the report, and return what they say: the summary and the report's verdict."""
    add_dense_doubts(run)
    summary = summarise(run, run.result, started=started, seconds=time.perf_counter() - clock)
    with replacing(out / "run.json") as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(json.JSONEncoder(indent=1, allow_nan=False).iterencode(summary))
        stream.write("\n")
    return summary, write_report(out, summary, StoredValues.of_run(run, summary["results"]))


def tell_of_end(run: Run, error: BaseException, tell: Callable[[], object]) -> None:
    """Tell of a run that did not get to its end, unless it did nothing: then the report before stays."""
    if not any(stage.run + stage.cached + stage.failed for stage in run.result.stages):
        return
    interrupted = isinstance(error, KeyboardInterrupt)
    run.result.stopped = "interrupted" if interrupted else _why(error)
    run.result.exit_code = INTERRUPTED if interrupted else error.exit_code if isinstance(error, PanoMvsError) else 1
    try:
        tell()
    except (PanoMvsError, OSError) as second:
        error.add_note(f"Nor could the report be written: {second}")


def _why(error: BaseException) -> str:
    return exit_text(error) if isinstance(error, SystemExit) else str(error)
