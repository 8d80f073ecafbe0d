"""Show the progress of a run: live lines on a terminal, plain lines now and then elsewhere."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import TextIO, cast

from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pano_mvs.cli.console import Console
from pano_mvs.cli.streams import apart
from pano_mvs.core.text import clock_text, duration_text, one_line, shortened, shortened_list
from pano_mvs.engine.running.events import StageFinished, UnitFailed, Warned
from pano_mvs.session.progress import Event, Forecast, KernelsCompiled, RunStarted, TimeLeft
from pano_mvs.session.time_estimator import Countdown, StageProgress, TimeEstimator

_SHOWN_STAGES = 6
_BAR_WIDTH = 20
_NAME_WIDTH = 14


class ProgressDisplay:
    """A progress callback that shows the progress of a run; a context within which the display is live."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = console
        self._clock = clock
        self._lock = threading.RLock()  # the display is drawn by a thread of its own
        self._restart()
        self._file = cast(TextIO, console.file)
        self._open = ExitStack()
        self._beginning = "starting"  # what is done before any unit

    def _restart(self) -> None:
        """Forget an earlier run."""
        self._estimator, self._countdown, self._began = TimeEstimator(self._clock), Countdown(), self._clock()
        self._kernels, self._kernels_at = 0, -math.inf
        self._groups: Mapping[str, str] = {}  # stage to its group

    def __enter__(self) -> ProgressDisplay:
        """Start to draw, on a stream that stays when the output of units is captured (executor `serial`)."""
        if (stream := apart(self._file)) is not self._file:
            self.console.file = self._open.enter_context(stream)
        if self.console.is_terminal:
            self._open.enter_context(
                Live(
                    get_renderable=self.live_lines,
                    console=self.console,
                    refresh_per_second=4,
                    transient=True,
                    redirect_stdout=False,
                    redirect_stderr=False,
                )
            )
        else:
            ended = threading.Event()
            thread = threading.Thread(target=self._print_lines, args=(ended,), daemon=True)
            thread.start()
            self._open.callback(thread.join)
            self._open.callback(ended.set)  # called before the other one
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing."""
        self._open.close()
        self.console.file = self._file

    def __call__(self, event: Event) -> None:
        """Show an event."""
        with self._lock:
            if isinstance(event, RunStarted):
                self._restart()
            self._estimator(event)
        if not isinstance(event, Warned):
            self._beginning = "listing the images and looking for copies" if isinstance(event, RunStarted) else ""
        match event:
            case RunStarted(groups=groups):
                self._groups = groups
            case Forecast():
                self._countdown = Countdown()  # begin with the forecast rather than glide to it
            case KernelsCompiled(kernels=kernels):
                self._kernels, self._kernels_at = kernels, self._clock()
            case UnitFailed():
                label = f"{event.stage}:{event.item}" if event.item else event.stage
                self.console.say(f"[red]failed[/] {escape(one_line(f'{label}: {shortened(event.cause, 300)}'))}")
                for line in event.said[-5:]:
                    self.console.say(f"  | {escape(line)}")
            case StageFinished():
                parts = [f"{event.run} run", f"{event.cached} cached"]
                parts += [
                    f"{count} {what}" for what, count in (("failed", event.failed), ("blocked", event.blocked)) if count
                ]
                name = one_line(event.stage).ljust(_NAME_WIDTH)
                self.console.print(escape(f"{name} {', '.join(parts)}  {event.seconds:.1f} s"), highlight=False)
            case Warned(text=text):
                self.console.print(f"[yellow]warning:[/] {escape(text)}", highlight=False)
            case _:
                pass  # the live lines show it

    def live_lines(self) -> Group:
        """Return the stages that are being computed, and the state of the whole run."""
        with self._lock:
            now, left = self._clock(), self._estimator.estimate()
            seconds_left = self._countdown.show(left.seconds_left, now)
            stages = self._running()
            table = Table.grid(padding=(0, 2))
            for name, stage in stages[:_SHOWN_STAGES]:
                bar = ProgressBar(total=max(1, stage.units or 1), completed=stage.done, width=_BAR_WIDTH)
                group = [Text(one_line(self._groups.get(name, "")))] if self._groups else []
                table.add_row(
                    Text(one_line(name).ljust(_NAME_WIDTH)),
                    *group,
                    bar,
                    _count(stage),
                    clock_text(stage.own_s(now)),
                    _units(stage),
                )
            if len(stages) > _SHOWN_STAGES:
                table.add_row(f"… and {len(stages) - _SHOWN_STAGES} more")
            if compiling := self._compiling():
                table.add_row(Text(compiling))
            total = Table.grid(padding=(0, 2))
            text = self._left_text(left, clock_text(math.ceil(seconds_left)), seconds_left)
            total.add_row(
                Text("all".ljust(_NAME_WIDTH), style="bold"),
                ProgressBar(total=1.0, completed=left.done, width=_BAR_WIDTH),
                f"{100 * left.done:.0f} %",
                clock_text(now - self._began),
                Text(text, overflow="ellipsis", no_wrap=True),
            )
            return Group(table, total, *map(Text, self._further()))

    def print_line(self) -> None:
        """Print the state of the run in one line."""
        with self._lock:
            left = self._estimator.estimate()
            text = self._left_text(left, duration_text(left.seconds_left), left.seconds_left)
            stages = [f"{self._place(name)} {_count(stage)}" for name, stage in self._running()]
            stages += filter(None, [self._compiling()])
            now = f" (now: {shortened_list(stages)})" if stages else ""
            line = "; ".join([f"{100 * left.done:.0f} %, {text}{now}", *self._further()])
        self.console.say(escape(line))

    def _print_lines(self, ended: threading.Event) -> None:
        pause_s = 10.0
        while not ended.wait(pause_s):
            self.print_line()
            pause_s = 30.0

    def _further(self) -> list[str]:
        """Return lines to show below the others."""
        return []

    def _running(self) -> list[tuple[str, StageProgress]]:
        return [(name, stage) for name, stage in self._estimator.stages.items() if stage.running]

    def _place(self, stage: str) -> str:
        """Return the name of a stage after that of its group, which plans and the report list."""
        group = self._groups.get(stage, "")
        return one_line(f"{group}: {stage}" if group else stage)

    def _compiling(self) -> str:
        """Return how many kernels have been compiled, while they are; else nothing."""
        # Kernels are shown to be compiled for this long after one was: some take so long.
        is_current = self._clock() - self._kernels_at < 20.0
        return f"compiling kernels (once): {self._kernels} so far" if is_current else ""

    def _left_text(self, left: TimeLeft, shown: str, seconds: float) -> str:
        if self._beginning:
            return self._beginning
        if self._estimator.is_reporting:
            return f"about {shown} left (writing the report)"
        if not left.at_least:
            return f"about {shown} left"
        compiling = ["the time to compile kernels (once)"] if left.compiles else []
        if seconds < 1 and not compiling:
            return f"time left not known yet: no earlier run has computed {shortened_list(map(one_line, left.unknown))}"
        unknown = shortened_list([*compiling, *map(one_line, left.unknown)])
        return f"time left not known yet: {unknown}" if seconds < 1 else f"more than {shown} left; not known: {unknown}"


def _count(stage: StageProgress) -> str:
    return f"{stage.done} of {stage.units}"


def _units(stage: StageProgress) -> Text:
    """Return the units that are being computed; nothing for a stage with a single unit."""
    names = [one_line(item) for item in stage.running if item]
    return Text(shortened_list(names, 2, rest=" and {more} more"), overflow="ellipsis", no_wrap=True)
