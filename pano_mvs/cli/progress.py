"""A progress bar per stage on a terminal, plain lines elsewhere."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from pano_mvs.engine.events import Outcome, StageSummary


class ProgressBars:
    """An observer of a run that draws it."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._tasks: dict[str, TaskID] = {}
        self._progress: Progress | None = None
        if console.is_terminal:
            columns = (TextColumn("{task.description:<14}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._progress = Progress(*columns, TextColumn("{task.fields[state]}"), console=console)

    def __enter__(self) -> ProgressBars:
        """Start drawing."""
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing."""
        if self._progress is not None:
            self._progress.stop()

    def stage_started(self, name: str, units: int) -> None:
        """Add a bar."""
        if self._progress is not None:
            self._tasks[name] = self._progress.add_task(name, total=units, state="")

    def unit_finished(self, name: str, item: str, outcome: Outcome, seconds: float) -> None:
        """Move the bar on; say at once what failed."""
        if self._progress is not None:
            self._progress.advance(self._tasks[name])
        if outcome == "failed":
            label = f"{name}:{item}" if item else name
            self.console.print(f"[red]failed[/] {escape(label)} after {seconds:.1f} s", highlight=False)

    def stage_finished(self, summary: StageSummary) -> None:
        """Say what the stage did."""
        parts = [f"{summary.run} run", f"{summary.cached} cached"]
        parts += [
            f"{count} {what}" for what, count in (("failed", summary.failed), ("blocked", summary.blocked)) if count
        ]
        text = ", ".join(parts)
        if self._progress is not None:
            self._progress.update(self._tasks[summary.name], state=text)
        else:
            self.console.print(f"{summary.name:<14} {text}  {summary.seconds:.1f} s", highlight=False)

    def warn(self, text: str) -> None:
        """Show a warning."""
        self.console.print(f"[yellow]warning:[/] {escape(text)}", highlight=False)
