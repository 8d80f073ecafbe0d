"""`pano-mvs watch`: follow a run, or a run in blocks, by the events in its output folder, from any terminal."""

from __future__ import annotations

import shutil
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import datetime
from pathlib import Path
from typing import TypeVar

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
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import clock_text, duration_text, one_line, plural
from pano_mvs.engine.running.events import StageStarted, UnitFailed, UnitFinished, Warned
from pano_mvs.engine.running.output_lock import is_run_gone
from pano_mvs.results.summary import BLOCKS
from pano_mvs.session.progress import (
    EVENTS_FILE,
    BlockStarted,
    Event,
    EventReader,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
)
from pano_mvs.session.time_estimator import StageProgress, TimeEstimator

View = TypeVar("View", bound="RunView | BlocksView")


def watch_run(out: Path, console: Console) -> int:
    """Show a run, or a run in blocks, until it ends, and return its exit code; 1 if it was killed."""
    blocks = out / BLOCKS
    in_blocks = is_file(blocks / EVENTS_FILE) and not is_file(out / EVENTS_FILE)
    folder = blocks if in_blocks else out
    reader = EventReader(folder)
    view: RunView | BlocksView = BlocksView(folder) if in_blocks else RunView(folder)
    with ExitStack() as stack:
        live = stack.enter_context(Live(console=console, auto_refresh=False, transient=True))
        next_line_s = time.monotonic()
        while True:
            is_gone = is_run_gone(folder)  # asked first, so that its last events are read
            try:
                view = _updated(view, reader)
            except OSError as error:
                raise InputError(
                    f"no run has begun in {out}: {folder / EVENTS_FILE} cannot be read ({error.strerror}). Give the "
                    "output folder of a run"
                ) from error
            if is_gone or view.end is not None:
                break
            if console.is_terminal:
                live.update(view.shown(), refresh=True)
            elif time.monotonic() >= next_line_s:
                console.say(escape(view.left_text()))
                next_line_s += 30.0
            time.sleep(1.0)
    console.print(view.shown())
    console.say(escape(_ending(view.end)))
    return 1 if view.end is None else view.end.exit_code


def _updated(view: View, reader: EventReader, since_s: float = 0.0) -> View:
    """Return the view after the new events; another one if another run has begun.

    Args:
        since_s: in seconds since 1970; earlier events are of an earlier run, which this one has not replaced yet.
    """
    is_new, events = reader.read()
    view = type(view)(view.folder) if is_new else view
    for at, event in events:
        if at >= since_s:
            view.take(at, event)
    if isinstance(view, BlocksView):
        view.update()
    return view


def _ending(end: RunFinished | None) -> str:
    """Return how a run ended, in words; None if it was killed."""
    if end is None:
        return "the run was killed; the same command continues it"
    verdict = end.verdict.judgement if end.verdict is not None else ""
    reason = f": {end.stopped}" if end.stopped not in ("", "interrupted") else ""
    text = f"{ending_text(end.exit_code)} (exit code {end.exit_code})"
    return f"{text} after {duration_text(end.seconds)}{reason}{f'. {verdict}' if verdict else ''}"


class BlocksView:
    """What the events of a run in blocks say about it: the present block, and what is still to come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder  # with the output folders of the blocks
        self.end: RunFinished | None = None  # its last event; None while it runs
        self._block: BlockStarted | None = None
        self._since_s = 0.0
        self._run = RunView(folder)  # of the block
        self._reader = EventReader(folder)

    def take(self, at: float, event: Event) -> None:
        """Take an event into account; see `RunView.take`."""
        match event:
            case BlockStarted():
                folder = self.folder / event.block
                self._block, self._since_s, self._run, self._reader = event, at, RunView(folder), EventReader(folder)
            case RunFinished():
                self.end = event
            case _:
                pass

    def update(self) -> None:
        """Take the new events of the block into account."""
        if self._block is not None:
            with suppress(OSError):  # its run has not begun
                self._run = _updated(self._run, self._reader, self._since_s)

    def shown(self) -> Group:
        """Return all of it."""
        lines = [f"{self._block.block}: {_ending(self._run.end)}"] if self._block and self._run.end else []
        lines += [] if self.end else [self._left_in_all()]
        return Group(Text(self._heading(), style="bold"), self._run.shown(), *map(Text, filter(None, lines)))

    def left_text(self) -> str:
        """Return the time left of the block, and of all blocks."""
        return "; ".join(filter(None, (self._heading(), self._run.left_text(), self._left_in_all())))

    def _heading(self) -> str:
        block = self._block
        if block is None:
            return "starting"
        return f"block {block.number} of {block.blocks}, {block.images} {plural(block.images, 'image')}"

    def _left_in_all(self) -> str:
        """Return the time left if the blocks to come take as long as this one, for each image; empty if unknown."""
        block, left = self._block, self._run.left()
        if block is None or not self._run.has_begun:
            return ""
        if not block.images_left:
            return "all blocks have run" if self._run.end else ""
        later_s = (self._run.elapsed_s() + left.seconds_left) * block.images_left / block.images
        about = "more than" if left.at_least else "about"
        return f"all blocks: {about} {clock_text(left.seconds_left + later_s)} left, if the later ones take as long"


class RunView:
    """What the events of a run say about it."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self.end: RunFinished | None = None  # its last event; None while it runs
        self.folder = folder
        self._clock = clock
        self._start: RunStarted | None = None
        self._began = self._latest = clock()
        self._workers = 0
        self._estimator = TimeEstimator(lambda: self._now)
        self._now = 0.0
        self._unsuccessful: Counter[str] = Counter()  # stage to its failed and blocked units
        self._failures: deque[UnitFailed] = deque(maxlen=5)
        self._failed = 0
        self._warnings: deque[str] = deque(maxlen=3)
        self._ends: deque[tuple[float, float]] = deque()  # time of an estimate, and when the run would end by it

    def take(self, at: float, event: Event) -> None:
        """Take an event into account.

        Args:
            at: its time, in seconds since 1970.
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
        lines = [f"failed {failure.stage}:{one_line(failure.item)}: {failure.cause}" for failure in self._failures]
        if self._failed > len(lines):
            lines.insert(0, f"{self._failed} units failed; the latest:")
        return Group(
            *(Text(line, style="bold") for line in self._heading()),
            self._stages(),
            *(Text(line) for line in ([] if self.end else [self.left_text(), self._disk()])),
            *(Text(line, style="yellow") for line in self._silence()),
            *(Text(f"warning: {text}", style="yellow") for text in self._warnings),
            *(Text(line, style="red") for line in lines),
        )

    def left_text(self) -> str:
        """Return the time left, with the range of the estimates of the second half of the run so far.

        Estimates by which the run would have ended by now do not count.
        """
        if not self.has_begun:
            return "starting"
        left = self.left()
        about = "more than" if left.at_least else "about"
        text = f"{100 * left.done:.0f} %, {about} {clock_text(left.seconds_left)} left"
        if left.at_least:
            return f"{text}; nothing is known of {', '.join(map(one_line, left.unknown))}"
        ends = [end - self._now for _, end in self._ends if end > self._now] + [left.seconds_left]
        clock = datetime.fromtimestamp(self._now + left.seconds_left).strftime("%H:%M")
        return f"{text} ({clock_text(min(ends))} to {clock_text(max(ends))}), until about {clock}"

    @property
    def has_begun(self) -> bool:
        """Whether the first event was taken."""
        return self._start is not None

    def left(self) -> TimeLeft:
        """Return the estimate of the time left at this moment."""
        self._now = max(self._latest, self._clock())
        return self._estimator.estimate()

    def elapsed_s(self) -> float:
        """Return the time since its beginning, or that it took."""
        return self.end.seconds if self.end else max(self._latest, self._clock()) - self._began

    def _heading(self) -> list[str]:
        if self._start is None:
            return ["starting"]
        start = self._start
        name = f"{one_line(start.workflow)} in {self.folder}"
        workers = f"{start.executor}, {self._workers} {plural(self._workers, 'worker')} of {start.threads} "
        return [f"{name}: {workers}{plural(start.threads, 'thread')}, {clock_text(self._now - self._began)}"]

    def _stages(self) -> Table:
        table = Table("stage", "", "done", "running", "failed", "time", box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for name, stage in self._estimator.stages.items():
            bar = ProgressBar(total=max(1, stage.units or 1), completed=stage.done, width=20)
            running = str(len(stage.running) or "")
            failed = Text(str(self._unsuccessful[name] or ""), style="red")
            time_text = clock_text(stage.own_s(self._now)) if stage.units is not None else ""
            table.add_row(Text(one_line(name)), bar, _done(stage), running, failed, time_text)
        return table

    def _disk(self) -> str:
        cache = self._start.cache if self._start is not None else self.folder
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
        if silent_s < 60.0:
            return []
        return [f"no event for {duration_text(silent_s)}: the run is computing a long unit, or its host has failed"]


def _done(stage: StageProgress) -> str:
    if stage.units is not None:
        return f"{stage.done} of {stage.units}"
    return "" if stage.forecast.units is None else f"about {stage.forecast.units + stage.forecast.cached}"
