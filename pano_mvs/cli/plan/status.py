"""Show what the latest run did, and what is cached now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.plan.command import show_plan
from pano_mvs.cli.run.printing import print_verdict
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.results.summary import RUN_JSON, RunSummary
from pano_mvs.session.commands import reopen, run_command


def show_status(
    target: str,
    out: Path | None,
    *,
    overrides: Sequence[str],
    images: Path | None,
    cache: Path | None,
    console: Console,
) -> None:
    """Print the outcome of the latest run into an output folder, then what its workflow would compute now.

    Args:
        target: a workflow, or an output folder, whose run.json states workflow, settings, images and cache.
        out: output folder of a workflow; None for the default.
        overrides: settings.
        images: folder of panoramas.
        cache: folder of the cache.
        console: where to print.

    Raises:
        InputError: if an output folder has no run.json, or its workflow is missing.
    """
    if is_folder(Path(target)):
        _print_latest(Path(target), console)
    session = reopen(target, overrides=overrides, images=images, cache=cache)
    session = session if out is None else replace(session, out=out)
    if not is_folder(Path(target)):
        _print_latest(session.out, console)
    run_plan = show_plan(session, console)
    if run_plan.units:
        console.print("to compute this:", highlight=False)
        console.print(f"  {escape(run_command(session))}", highlight=False, soft_wrap=True)


def _print_latest(out: Path, console: Console) -> None:
    if not is_file(out / RUN_JSON):
        console.print(f"no finished run in {escape(str(out))}", highlight=False)
        return
    try:
        latest = RunSummary.read(out)
    except InputError as error:
        console.print(escape(str(error)), highlight=False, soft_wrap=True)
        return
    units = latest.units
    text = f"exit code {latest.exit_code}, {units.run} computed, {units.cached} cached, {units.failed} failed"
    console.print(f"latest run {latest.started}: {text}", highlight=False)
    for failure in latest.failures:
        console.print(escape(f"  {failure.label}: {failure.cause}"), highlight=False, soft_wrap=True)
    if latest.stopped:
        console.print(escape(f"  stopped: {latest.stopped}"), highlight=False, soft_wrap=True)
    if latest.verdict is not None:
        print_verdict(latest.verdict, console)
