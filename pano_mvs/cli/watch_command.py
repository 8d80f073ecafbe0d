"""`pano-mvs watch`: follow a run, or a run in blocks, by the events in its output folder, from any terminal."""

from __future__ import annotations

import shutil
import time
from collections import deque
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import ending_text
from pano_mvs.cli.run.progress import ProgressDisplay
from pano_mvs.core.errors import InputError
from pano_mvs.core.memory import size_text
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import clock_text, duration_text, one_line, plural
from pano_mvs.engine.running.output_lock import is_run_gone
from pano_mvs.results.summary import BLOCKS, INTERRUPTED
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


def watch_run(out: Path, console: Console) -> int:
    """Show a run, or a run in blocks, until it ends, and return its exit code; 1 if it was killed."""
    blocks = out / BLOCKS
    folder = blocks if is_file(blocks / EVENTS_FILE) and not is_file(out / EVENTS_FILE) else out
    with WatchDisplay(folder, console) as watched:
        while True:
            is_gone = is_run_gone(folder)  # asked first, so that its last events are read
            try:
                watched.update()
            except OSError as error:
                raise InputError(
                    f"no run has begun in {out}: {folder / EVENTS_FILE} cannot be read ({error.strerror}). Give the "
                    "output folder of a run"
                ) from error
            if is_gone or watched.end is not None:
                break
            time.sleep(1.0)
    console.say(escape(_ending(watched.end)))
    return 1 if watched.end is None else watched.end.exit_code


def _ending(end: RunFinished | None) -> str:
    """Return how a run ended, in words; None if it was killed."""
    if end is None:
        return "the run was killed; the same command continues it"
    verdict = end.verdict.judgement if end.verdict is not None else ""
    reason = f": {end.stopped}" if end.stopped and end.exit_code != INTERRUPTED else ""
    text = f"{ending_text(end.exit_code)} (exit code {end.exit_code})"
    return f"{text} after {duration_text(end.seconds)}{reason}{f'. {verdict}' if verdict else ''}"


class WatchDisplay(ProgressDisplay):
    """The display of a run, or of a run in blocks, by the events that it writes into a folder."""

    def __init__(self, folder: Path, console: Console) -> None:
        self.end: RunFinished | None = None  # the last event; None while the run goes on
        self._at: float | None = None  # time of the event that is being taken into account
        self._latest = 0.0  # time of the latest event
        super().__init__(console, lambda: max(self._latest, time.time()) if self._at is None else self._at)
        self._folder = folder
        self._reader = EventReader(folder)
        self._block: BlockStarted | None = None
        self._block_reader: EventReader | None = None
        self._block_since_s = 0.0  # events before it are of an earlier run of the block

    def __enter__(self) -> WatchDisplay:
        """Start to draw."""
        super().__enter__()
        return self

    def _restart(self) -> None:
        super()._restart()
        self._start: RunStarted | None = None
        self._workers = 0
        self._ends: deque[tuple[float, float]] = deque()  # time of an estimate, and when the run would end by it

    def update(self) -> None:
        """Take new events into account.

        Raises:
            OSError: if there is no file with events.
        """
        with self._lock:
            for at, event in self._reader.read()[1]:
                self._take(at, event)
                self.end = event if isinstance(event, RunFinished) else self.end
            if self._block_reader is not None:
                with suppress(OSError):  # its run has not begun
                    for at, event in self._block_reader.read()[1]:
                        if at >= self._block_since_s:
                            self._take(at, event)
                            if self._block is not None and isinstance(event, RunFinished):
                                self.console.say(escape(f"{self._block.block}: {_ending(event)}"))
            self._at = None

    def _take(self, at: float, event: Event) -> None:
        self._at = self._latest = at
        self(event)
        match event:
            case RunStarted():
                self._start, self._workers = event, event.workers
                threads = f"{event.threads} {plural(event.threads, 'thread')}"
                workers = f"{event.executor}, {event.workers} {plural(event.workers, 'worker')} of {threads}"
                self.console.say(escape(f"{one_line(event.workflow)} in {event.out}: {workers}"))
            case WorkersChanged():
                self._workers = event.workers
            case TimeLeft(at_least=False):
                self._ends.append((at, at + event.seconds_left))
                while self._ends[0][0] < (self._began + at) / 2:
                    self._ends.popleft()
            case BlockStarted():
                self._block, self._block_since_s = event, at
                self._block_reader = EventReader(self._folder / event.block)
                images = f"{event.images} {plural(event.images, 'image')}"
                self.console.say(f"[bold]block {event.number} of {event.blocks}[/], {images}")
                self._restart()
                self._beginning = "starting"
            case _:
                pass

    def _further(self) -> list[str]:
        """Return what is known of all blocks, the workers and the disk, and whether the run is silent."""
        silent_s = self._clock() - self._latest
        lines = [self._left_in_all(), self._disk()]
        if self._start is not None and silent_s >= 60.0:
            why = "the run is computing a long unit, or its host has failed"
            lines.append(f"no event for {duration_text(silent_s)}: {why}")
        return [line for line in lines if line]

    def _left_text(self, left: TimeLeft, shown: str, seconds: float) -> str:
        """Return the time left, with the range of the estimates of the second half of the run so far.

        Estimates by which the run would have ended by now do not count.
        """
        text = super()._left_text(left, shown, seconds)
        if self._beginning or left.at_least:
            return text
        now = self._clock()
        ends = [end - now for _, end in self._ends if end > now] + [seconds]
        until = datetime.fromtimestamp(now + seconds).strftime("%H:%M")
        return f"{text} ({clock_text(min(ends))} to {clock_text(max(ends))}), until about {until}"

    def _left_in_all(self) -> str:
        """Return the time left if the blocks to come take as long as this one, for each image; empty if unknown."""
        block = self._block
        if block is None or self._start is None or not block.images_left:
            return ""
        left, so_far_s = self._estimator.estimate(), self._clock() - self._began
        later_s = (so_far_s + left.seconds_left) * block.images_left / block.images
        about = "more than" if left.at_least else "about"
        return f"all blocks: {about} {clock_text(left.seconds_left + later_s)} left, if the later ones take as long"

    def _disk(self) -> str:
        if self._start is None:
            return ""
        workers = f"{self._workers} {plural(self._workers, 'worker')}"
        try:
            free = f"{size_text(shutil.disk_usage(self._start.cache).free)} free for the cache"
        except OSError as error:
            return f"{workers}; the cache {self._start.cache} cannot be seen from here ({error.strerror})"
        kept = [stage for stage in self._estimator.stages.values() if not stage.forecast.is_temporary]
        left = [(stage.units_left(), stage.forecast.unit_bytes) for stage in kept]
        known = [units * size for units, size in left if units is not None and size is not None]
        is_least = any(units != 0 and (units is None or size is None) for units, size in left)
        about = "at least" if is_least else "about"
        return f"{workers}; {free}, {about} {size_text(round(sum(known)))} still to come"
