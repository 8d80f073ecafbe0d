"""`pano-mvs run`: run a workflow with progress on the terminal, or as JSON lines for programs, and say how it ended."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import ending_text
from pano_mvs.cli.run.printing import next_commands, print_summary
from pano_mvs.cli.run.progress import ProgressDisplay
from pano_mvs.cli.streams import apart
from pano_mvs.core.errors import InputError, PanoMvsError, UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.text import duration_text
from pano_mvs.engine.running.events import ignore
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.summary import RUN_JSON, RunSummary
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


@contextmanager
def notified(urls: Sequence[str], out: Path) -> Iterator[None]:
    """Send a message when the run inside the context has ended in any way; a warning is printed if that is impossible.

    Args:
        urls: where to, as apprise writes it; nothing is sent if there are none.
    """
    if not urls:
        yield
        return
    messenger = _messenger(urls)
    earlier, began, code, reason = _run_json(out), time.monotonic(), 1, ""
    try:
        yield
        code = 0
    except typer.Exit as end:
        code = end.exit_code
        raise
    except PanoMvsError as error:
        code, reason = error.exit_code, str(error)
        raise
    except KeyboardInterrupt:
        code = 130
        raise
    finally:
        verdict = _verdict(out) if _run_json(out) != earlier else ""
        lines = [verdict, reason, f"{duration_text(time.monotonic() - began)}, {out.absolute()}"]
        title = f"pano-mvs: {out.name}: {ending_text(code)}"
        if not messenger.notify(title=title, body="\n".join(filter(None, lines))):
            places = ", ".join(url.partition(":")[0] for url in urls)  # the rest may be secret
            Console(stderr=True).say(f"[yellow]warning:[/] the message could not be sent to {escape(places)}")


def _messenger(urls: Sequence[str]) -> Any:
    messenger = import_extra("apprise", "--notify", "notify").Apprise()
    for url in urls:
        if not messenger.add(url):
            raise UsageError(
                f"--notify {url}: must be a URL such as mailto://user:password@example.com or ntfy://topic; "
                "https://github.com/caronc/apprise lists all kinds"
            )
    return messenger


def _run_json(out: Path) -> bytes:
    try:
        return (out / RUN_JSON).read_bytes()
    except OSError:
        return b""


def _verdict(out: Path) -> str:
    try:
        verdict = RunSummary.read(out).verdict
    except InputError:
        return ""
    return verdict.judgement if verdict is not None else ""
