"""A progress bar per stage and one for the run on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from pano_mvs.cli.run.estimate import Estimate
from pano_mvs.session.progress import (
    Event,
    RunStarted,
    StageFinished,
    StageStarted,
    UnitFailed,
    UnitFinished,
    Warned,
)

_LINE_EVERY_S = 30.0
_SHOWN_LINES = 5


class ProgressBars:
    """A progress callback that draws the progress of a run."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._stages = 0
        self._estimate = Estimate()
        self._tasks: dict[str, TaskID] = {}
        self._run: TaskID | None = None
        self._progress: Progress | None = None
        self._next_line_s = time.monotonic() + _LINE_EVERY_S
        if console.is_terminal:
            columns = (TextColumn("{task.description:<14}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._progress = Progress(*columns, TextColumn("{task.fields[state]}"), console=console)

    def __enter__(self) -> ProgressBars:
        """Start drawing."""
        if self._progress is not None:
            self._progress.start()
            self._run = self._progress.add_task("[bold]all[/]", total=0, state="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing."""
        if self._progress is not None:
            self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Show an event."""
        match event:
            case RunStarted(stages=stages, workers=workers):
                self._stages, self._estimate = len(stages), Estimate(workers)
            case StageStarted():
                self._start_stage(event.stage, event.units)
            case UnitFailed():
                self._show_failure(event)
            case UnitFinished():
                self._count_unit(event)
            case StageFinished():
                self._finish_stage(event)
            case Warned(text=text):
                self.console.print(f"[yellow]warning:[/] {escape(text)}", highlight=False)
            case _:
                pass  # the bars show what is done

    def _start_stage(self, name: str, units: int) -> None:
        """Add a bar, or reset it."""
        self._estimate.start(name, units)
        if self._progress is None or self._run is None:
            return
        if name in self._tasks:
            self._progress.reset(self._tasks[name], total=units, state="")
        else:
            self._tasks[name] = self._progress.add_task(escape(name), total=units, state="")
        known = self._estimate.stages.values()
        self._progress.update(
            self._run, total=sum(clock.units for clock in known), completed=sum(c.done for c in known)
        )

    def _show_failure(self, failure: UnitFailed) -> None:
        """Print a failure and the last lines of the unit's output."""
        label = f"{failure.stage}:{failure.item}" if failure.item else failure.stage
        self.console.print(f"[red]failed[/] {escape(label)}", highlight=False, soft_wrap=True)
        for line in failure.said[-_SHOWN_LINES:]:
            self.console.print(f"  | {escape(line)}", highlight=False, soft_wrap=True)

    def _count_unit(self, unit: UnitFinished) -> None:
        """Advance the bars, or print a line now and then."""
        name = unit.stage
        self._estimate.count(name, unit.seconds, computed=unit.outcome in ("run", "failed"))
        if self._progress is not None and self._run is not None:
            self._progress.update(self._tasks[name], advance=1, state=self._estimate.of_stage(name))
            self._progress.update(self._run, advance=1, state=self._estimate.of_run(self._stages))
        elif time.monotonic() > self._next_line_s:
            self._next_line_s = time.monotonic() + _LINE_EVERY_S
            clock = self._estimate.stages[name]
            times = {"stage": self._estimate.of_stage(name), "run": self._estimate.of_run(self._stages)}
            left = ", ".join(f"{whose}: {text}" for whose, text in times.items() if text)
            self.console.print(f"{name:<14} {clock.done} of {clock.units}  {left}", highlight=False)

    def _finish_stage(self, summary: StageFinished) -> None:
        """Show what the stage did."""
        parts = [f"{summary.run} run", f"{summary.cached} cached"]
        parts += [
            f"{count} {what}" for what, count in (("failed", summary.failed), ("blocked", summary.blocked)) if count
        ]
        text = ", ".join(parts)
        if self._progress is not None:
            self._progress.update(self._tasks[summary.stage], state=text)
        else:
            self.console.print(f"{summary.stage:<14} {text}  {summary.seconds:.1f} s", highlight=False)
