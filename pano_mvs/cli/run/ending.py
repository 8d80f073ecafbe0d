"""How a run ended, in words, and the message about it that `pano-mvs run --notify` sends."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import InputError, PanoMvsError, UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.text import duration_text
from pano_mvs.results.summary import RUN_JSON, RunSummary

_ENDINGS = {
    0: "finished",
    2: "not possible: there is a mistake in the command, the workflow or the input",
    3: "finished, but some items failed or were left out, or some cameras are doubtful",
    4: "stopped by a quality threshold or a safety check",
    130: "interrupted",
}


def ending_text(exit_code: int) -> str:
    """Return how a run ended, by its exit code."""
    return _ENDINGS.get(exit_code, "ended by an internal error")


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
