"""Print the events of a run as JSON objects, one per line, for programs.

Every object has `event` and `time` (seconds since 1970). The events, in the order in which they can come:

    run_started     schema (1), workflow, stages (names, in order), executor, workers, threads, out
    forecast        stages (stage, after, cached, units, unit_s, unit_bytes; null if unknown), report_s
    kernels_compiled  kernels (so far), seconds (since the count before); at most once a second, in a first run
    stage_started   stage, units
    unit_started    stage, item                             only for units that are computed
    unit_failed     stage, item, cause, consequence, log (file or ""), said (the last lines that it printed)
    unit_finished   stage, item, outcome ("run" | "cached" | "failed" | "blocked"), seconds
    stage_finished  stage, use, units, run, cached, failed, blocked, seconds, unit_seconds, metrics
    time_left       seconds_left, at_least, done (0 to 1), unknown (stages); at most once a second
    warning         text
    run_finished    exit_code, stopped, run, cached, failed, blocked, seconds, out; and of a run that was not broken off
                    verdict (mood, outcome, judgement, sentence, tiles, findings (mood, text, remedy), as in the
                    report) and doubts (image to reason)

`item` is empty if a stage has a single unit. Stages overlap. If a damaged result is found in the cache, the run starts
over: `stage_started` is repeated for every stage, and earlier counts no longer apply. `run_finished` is always
the last line, also after an interrupt (130) or an error (stated in `stopped`), unless the
process is killed. Later versions may add fields, but will not change the meaning of any.
"""

from __future__ import annotations

import dataclasses
import json
import time
from typing import Any, TextIO

from pano_mvs.core.text import json_without_controls
from pano_mvs.session.progress import Event, RunFinished, RunStarted

SCHEMA = 1


class JsonEvents:
    """A progress callback that writes the events of a run as JSON lines."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        """Write one event."""
        fields: dict[str, Any] = {"event": event.kind, "time": round(time.time(), 3)}
        if isinstance(event, RunStarted):
            fields["schema"] = SCHEMA
        fields |= dataclasses.asdict(event)
        if isinstance(event, RunFinished) and event.verdict is None:
            del fields["verdict"], fields["doubts"]
        line = json.dumps(fields, ensure_ascii=False, allow_nan=False, default=str)
        self._stream.write(json_without_controls(line) + "\n")
        self._stream.flush()
