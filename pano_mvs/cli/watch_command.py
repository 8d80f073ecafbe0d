"""`pano-mvs watch`: follow a run by the events in its output folder, from any terminal that sees it."""

from __future__ import annotations

import shutil
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path

from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.ending import ending_text
from pano_mvs.core.errors import InputError
from pano_mvs.core.memory import size_text
from pano_mvs.core.text import clock_text, duration_text, one_line, plural
from pano_mvs.engine.running.output_lock import is_run_gone
from pano_mvs.session.event_log import EVENTS_FILE, EventReader
from pano_mvs.session.progress import (
    Event,
    RunFinished,
    RunStarted,
    StageStarted,
    TimeLeft,
    UnitFailed,
    UnitFinished,
    Warned,
    WorkersChanged,
)
from pano_mvs.session.time_estimator import StageProgress, TimeEstimator

_EVERY_S = 1.0
_LINE_EVERY_S = 30.0
_SILENT_S = 60.0
_SHOWN_FAILURES = 5
_SHOWN_WARNINGS = 3
_BAR_WIDTH = 20
_KILLED = 1


def watch_run(out: Path, console: Console) -> int:
    """Show a run until it ends, and return its exit code; 1 if it was killed.

    Raises:
        InputError: if no run has begun in the folder.
    """
    reader, view = EventReader(out), RunView(out)
    with ExitStack() as stack:
        live = stack.enter_context(Live(console=console, auto_refresh=False, transient=True))
        next_line_s = time.monotonic()
        while True:
            is_gone = is_run_gone(out)  # asked first, so that its last events are read
            view = _updated(view, reader, out)
            if is_gone or view.end is not None:
                break
            if console.is_terminal:
                live.update(view.shown(), refresh=True)
            elif time.monotonic() >= next_line_s:
                console.say(escape(view.left_text()))
                next_line_s += _LINE_EVERY_S
            time.sleep(_EVERY_S)
    console.print(view.shown())
    console.say(escape(view.ending()))
    return _KILLED if view.end is None else view.end.exit_code


def _updated(view: RunView, reader: EventReader, out: Path) -> RunView:
    """Return the view after the new events; another one if another run has begun."""
    try:
        is_new, events = reader.read()
    except OSError as error:
        raise InputError(
            f"no run has begun in {out}: {out / EVENTS_FILE} cannot be read ({error.strerror}). Give the output folder "
            "of a run"
        ) from error
    view = RunView(out) if is_new else view
    for at, event in events:
        view.take(at, event)
    return view


class RunView:
    """What the events of a run say about it.

    Attributes:
        end: its last event; None while it runs.
    """

    def __init__(self, out: Path, clock: Callable[[], float] = time.time) -> None:
        self.end: RunFinished | None = None
        self._out = out
        self._clock = clock
        self._start: RunStarted | None = None
        self._began = self._latest = clock()
        self._workers = 0
        self._estimator = TimeEstimator(lambda: self._now)
        self._now = 0.0
        self._unsuccessful: Counter[str] = Counter()  # stage to its failed and blocked units
        self._failures: deque[UnitFailed] = deque(maxlen=_SHOWN_FAILURES)
        self._failed = 0
        self._warnings: deque[str] = deque(maxlen=_SHOWN_WARNINGS)
        self._ends: deque[tuple[float, float]] = deque()  # time of an estimate, and when the run would end by it

    def take(self, at: float, event: Event) -> None:
        """Take an event into account.

        Args:
            at: its time, in seconds since 1970.
            event: the event.
        """
        self._now = self._latest = at
        match event:
            case RunStarted():
                self._start, self._began, self._workers = event, at, event.workers
            case WorkersChanged():
                self._workers = event.workers
            case StageStarted():
                del self._unsuccessful[event.stage]
            case UnitFailed():
                self._failures.append(event)
                self._failed += 1
            case UnitFinished(outcome="failed" | "blocked"):
                self._unsuccessful[event.stage] += 1
            case TimeLeft(at_least=False):
                self._ends.append((at, at + event.seconds_left))
                while self._ends[0][0] < (self._began + at) / 2:
                    self._ends.popleft()
            case Warned():
                self._warnings.append(event.text)
            case RunFinished():
                self.end = event
            case _:
                pass
        self._estimator(event)

    def shown(self) -> Group:
        """Return all of it."""
        self._now = self._latest if self.end else max(self._latest, self._clock())
        return Group(
            *(Text(line, style="bold") for line in self._heading()),
            self._stages(),
            *(Text(line) for line in ([] if self.end else [self.left_text(), self._disk()])),
            *(Text(line, style="yellow") for line in self._silence()),
            *(Text(f"warning: {text}", style="yellow") for text in self._warnings),
            *(Text(line, style="red") for line in self._failure_lines()),
        )

    def left_text(self) -> str:
        """Return the time left, with the range of the estimates of the second half of the run so far.

        Estimates by which the run would have ended by now do not count.
        """
        self._now = max(self._latest, self._clock())
        left = self._estimator.estimate()
        about = "more than" if left.at_least else "about"
        text = f"{100 * left.done:.0f} %, {about} {clock_text(left.seconds_left)} left"
        if left.at_least:
            return f"{text}; nothing is known of {', '.join(map(one_line, left.unknown))}"
        ends = [end - self._now for _, end in self._ends if end > self._now] + [left.seconds_left]
        clock = datetime.fromtimestamp(self._now + left.seconds_left).strftime("%H:%M")
        return f"{text} ({clock_text(min(ends))} to {clock_text(max(ends))}), until about {clock}"

    def ending(self) -> str:
        """Return how the run ended, in words."""
        if self.end is None:
            return "the run was killed; the same command continues it"
        verdict = self.end.verdict.judgement if self.end.verdict is not None else ""
        reason = f": {self.end.stopped}" if self.end.stopped not in ("", "interrupted") else ""
        text = f"{ending_text(self.end.exit_code)} (exit code {self.end.exit_code})"
        return f"{text} after {duration_text(self.end.seconds)}{reason}{f'. {verdict}' if verdict else ''}"

    def _heading(self) -> list[str]:
        if self._start is None:
            return ["starting"]
        start = self._start
        name = f"{one_line(start.workflow)} in {self._out}"
        workers = f"{start.executor}, {self._workers} {plural(self._workers, 'worker')} of {start.threads} "
        return [f"{name}: {workers}{plural(start.threads, 'thread')}, {clock_text(self._now - self._began)}"]

    def _stages(self) -> Table:
        table = Table("stage", "", "done", "running", "failed", "time", box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for name, stage in self._estimator.stages.items():
            bar = ProgressBar(total=max(1, stage.units or 1), completed=stage.done, width=_BAR_WIDTH)
            running = str(len(stage.running) or "")
            failed = Text(str(self._unsuccessful[name] or ""), style="red")
            time_text = clock_text(stage.own_s(self._now)) if stage.units is not None else ""
            table.add_row(Text(one_line(name)), bar, _done(stage), running, failed, time_text)
        return table

    def _disk(self) -> str:
        cache = self._start.cache if self._start is not None else self._out
        try:
            free = f"{size_text(shutil.disk_usage(cache).free)} free for the cache"
        except OSError as error:
            return f"the cache {cache} cannot be seen from here ({error.strerror})"
        left = [(stage.units_left(), stage.forecast.unit_bytes) for stage in self._estimator.stages.values()]
        known = [units * size for units, size in left if units is not None and size is not None]
        is_least = any(units != 0 and (units is None or size is None) for units, size in left)
        return f"{free}, {'at least' if is_least else 'about'} {size_text(round(sum(known)))} still to come"

    def _silence(self) -> list[str]:
        silent_s = self._now - self._latest
        if silent_s < _SILENT_S:
            return []
        return [f"no event for {duration_text(silent_s)}: the run is computing a long unit, or its host has failed"]

    def _failure_lines(self) -> list[str]:
        lines = [f"failed {failure.stage}:{one_line(failure.item)}: {failure.cause}" for failure in self._failures]
        if self._failed > len(lines):
            lines.insert(0, f"{self._failed} units failed; the latest:")
        return lines


def _done(stage: StageProgress) -> str:
    if stage.units is not None:
        return f"{stage.done} of {stage.units}"
    return "" if stage.forecast.units is None else f"about {stage.forecast.units + stage.forecast.cached}"
