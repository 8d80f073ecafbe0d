"""`pano-mvs run`: run a workflow with progress on the terminal, or as JSON lines for programs, and say how it ended."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from types import FrameType

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import next_commands, print_summary
from pano_mvs.cli.run.progress import ProgressDisplay
from pano_mvs.cli.streams import apart
from pano_mvs.engine.running.events import ignore
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.progress import Event, Progress, line_from_event
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.scaling import lost_scale
from pano_mvs.session.session import Session


def run_workflow(session: Session, execution: Execution, *, as_json: bool = False, advise: bool = True) -> int:
    """Run a workflow, print progress and a summary, or events if `as_json`, and return the exit code.

    Args:
        advise: whether to print the commands that can follow.
    """
    if as_json:
        return run_with_events(partial(run_session, session, execution)).summary.exit_code
    stream = apart(sys.stdout)
    try:
        with interrupted_by_termination():
            return run_shown(session, execution, Console(file=stream), advise=advise).exit_code
    finally:
        if stream is not sys.stdout:
            stream.close()


def run_with_events(run: Callable[[Progress], RunOutput], watch: Progress = ignore) -> RunOutput:
    """Call a function that runs something with a callback for events, print these, and return its output.

    Args:
        watch: receives the events as well.
    """
    stream = apart(sys.stdout)

    def report(event: Event) -> None:
        stream.write(line_from_event(event))
        stream.flush()
        watch(event)

    try:
        with interrupted_by_termination(), redirect_stdout(sys.stderr):  # a plugin may print in this process
            return run(report)
    finally:
        if stream is not sys.stdout:
            stream.close()


def run_shown(session: Session, execution: Execution, console: Console, *, advise: bool) -> RunSummary:
    """Run a workflow, print progress and a summary, and return it."""
    with ProgressDisplay(console) as bars:
        output = run_session(session, execution, bars)
    print_summary(output, console, following=next_commands(output, session) if advise else ())
    if note := lost_scale(session):
        console.print(f"note: {note}", style="yellow", markup=False, highlight=False, soft_wrap=True)
    return output.summary


@contextmanager
def interrupted_by_termination() -> Iterator[None]:
    """Treat SIGTERM, and SIGHUP from a closing terminal, as an interrupt.

    A closing terminal sends SIGHUP more than once; only the first counts. Under nohup, SIGHUP stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach only the main thread
        return

    hangup = getattr(signal, "SIGHUP", None)
    ends = [signal.SIGTERM, *([hangup] if hangup and signal.getsignal(hangup) is not signal.SIG_IGN else [])]

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        if hangup is not None:
            signal.signal(hangup, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ends}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
