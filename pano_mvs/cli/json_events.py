"""What a run does, as a stream of JSON objects, one in a line, for programs.

Every object has `event` and `time` (seconds since 1970). The events, in the order in which they can come:

    run_started     schema (1), workflow, stages (names, in order), executor, workers, threads, out
    stage_started   stage, units
    unit_started    stage, item                             only for units that are computed
    unit_failed     stage, item, cause, consequence, log (file or ""), said (the last lines that it printed)
    unit_finished   stage, item, outcome ("run" | "cached" | "failed" | "blocked"), seconds
    stage_finished  stage, use, units, run, cached, failed, blocked, seconds, unit_seconds, metrics
    warning         text
    run_finished    exit_code, stopped, run, cached, failed, blocked, seconds, out; and of a run that was not broken off
                    verdict (mood, outcome, judgement, sentence, tiles, findings (mood, text, remedy), as in the
                    report) and doubts (image to reason)

`item` is empty where a stage has one unit only. Stages overlap. If a damaged part of the store is found, the run starts
over: `stage_started` comes again for every stage, and what was counted before does not count. `run_finished` is always
the last line, also of a run that is interrupted (130) or ends in an error (then `stopped` says which), unless the
process is killed. Fields may be added to a schema; none changes its meaning.
"""

from __future__ import annotations

import json
import time
from typing import Any, TextIO

from pano_mvs.core.text import json_without_controls
from pano_mvs.engine.running.events import Failure, StageSummary, UnitStatus

SCHEMA = 1


class JsonEvents:
    """An observer of a run that writes it down."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, event: str, **fields: Any) -> None:
        """Write one event."""
        line = json.dumps(
            {"event": event, "time": round(time.time(), 3), **fields}, ensure_ascii=False, allow_nan=False
        )
        self._stream.write(json_without_controls(line) + "\n")
        self._stream.flush()

    def stage_started(self, name: str, units: int) -> None:
        """Write the event."""
        self.write("stage_started", stage=name, units=units)

    def unit_started(self, name: str, item: str) -> None:
        """Write the event."""
        self.write("unit_started", stage=name, item=item)

    def unit_failed(self, failure: Failure) -> None:
        """Write the event."""
        self.write("unit_failed", stage=failure.stage, item=failure.item, cause=failure.cause,
                   consequence=failure.consequence, log=failure.log, said=list(failure.said))  # fmt: skip

    def unit_finished(self, name: str, item: str, *, status: UnitStatus, seconds: float) -> None:
        """Write the event."""
        self.write("unit_finished", stage=name, item=item, outcome=status, seconds=round(seconds, 6))

    def stage_finished(self, summary: StageSummary) -> None:
        """Write the event."""
        self.write("stage_finished", stage=summary.name, use=summary.use, units=summary.units, run=summary.run,
                   cached=summary.cached, failed=summary.failed, blocked=summary.blocked,
                   seconds=round(summary.seconds, 6), unit_seconds=round(summary.unit_seconds, 6),
                   metrics=summary.metrics)  # fmt: skip

    def warn(self, text: str) -> None:
        """Write the event."""
        self.write("warning", text=text)
