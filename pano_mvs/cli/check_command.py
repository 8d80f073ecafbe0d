"""`pano-mvs check`: report every mistake in a workflow, once or after each change of its files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console, print_json
from pano_mvs.core.errors import InputError, PanoMvsError, UsageError, WorkflowError
from pano_mvs.core.paths import stat_of
from pano_mvs.core.text import plural
from pano_mvs.engine.workflows.workflow import find_workflow
from pano_mvs.session.checking import WorkflowCheck, problems_of
from pano_mvs.session.session import open_session, presets_folder

_INTERVAL_S = 0.5


def check_workflow(
    workflow: str,
    overrides: Sequence[str],
    images: Path | None,
    *,
    on_file: Callable[[Path], None] = lambda _: None,
) -> None:
    """Check a workflow, and print that it has no mistakes.

    Args:
        on_file: called with each of its YAML files and plugins before it is read, and with those that are missing.

    Raises:
        WorkflowError: with every mistake and its location.
        UsageError: if there is no such workflow.
        InputError: if a file or the images cannot be read.
    """
    session = open_session(workflow, overrides=overrides, images=images, on_file=on_file)
    for reason in session.workflow.warnings:
        Console(stderr=True).say(f"[yellow]warning:[/] {escape(reason)}")
    count = len(session.workflow.stages)
    Console().print(f"{escape(workflow)}: {count} {plural(count, 'stage')}, no mistakes", highlight=False)


def print_checked(workflow: str, overrides: Sequence[str], images: Path | None) -> None:
    """Check a workflow, and print what is wrong with it as JSON; the exit code is that of `check_workflow`.

    Raises:
        UsageError: if there is no such workflow.
    """
    found = _checked(workflow, overrides, images)
    print_json(found.to_json())
    if not found.ok:
        raise typer.Exit(WorkflowError.exit_code)


def _checked(
    workflow: str, overrides: Sequence[str], images: Path | None, *, on_file: Callable[[Path], None] = lambda _: None
) -> WorkflowCheck:
    """Check a workflow, and return what is wrong with it."""
    try:
        session = open_session(workflow, overrides=overrides, images=images, on_file=on_file)
    except (WorkflowError, InputError) as error:
        return WorkflowCheck(workflow, problems=tuple(problems_of(error)))
    return WorkflowCheck(workflow, len(session.workflow.stages), warnings=tuple(session.workflow.warnings))


def watch_workflow(
    workflow: str,
    overrides: Sequence[str],
    images: Path | None,
    *,
    as_json: bool = False,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Check a workflow now and after each change of its files, until the user interrupts.

    After a check that fails, all files are watched that it has read or missed.

    Args:
        as_json: whether to print each check as a JSON object on a line.
        sleep: waits between two looks at the files.

    Raises:
        UsageError: if there is no such workflow at the beginning.
    """
    first = find_workflow(workflow, presets_folder())[0]
    while True:
        checked = {first: _time(first)}
        note = partial(_note, checked)
        try:
            if as_json:
                print(json.dumps(_checked(workflow, overrides, images, on_file=note).to_json()), flush=True)
            else:
                check_workflow(workflow, overrides, images, on_file=note)
        except (WorkflowError, UsageError, InputError) as error:
            if as_json:  # such as a file that is gone
                print(json.dumps(WorkflowCheck(workflow, problems=(str(error),)).to_json()), flush=True)
            else:
                _print(error)
        while all(_time(path) == before for path, before in checked.items()):
            sleep(_INTERVAL_S)
        if not as_json:
            Console().say("")


def _note(checked: dict[Path, tuple[int, int] | None], path: Path) -> None:
    """Add a file as it is before it is read; one that is read twice stays as it was at first."""
    if path not in checked:
        checked[path] = _time(path)


def _time(path: Path) -> tuple[int, int] | None:
    """Return the time stamp and the size of a file; None if it is not there."""
    known = stat_of(path)
    return None if known is None else (known.st_mtime_ns, known.st_size)


def _print(error: PanoMvsError) -> None:
    for problem in problems_of(error):
        Console(stderr=True).say(f"[red]error:[/] {escape(problem)}")
