"""`pano-mvs check`: report every mistake in a workflow, once or after each change of its files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import InputError, PanoMvsError, UsageError, WorkflowError
from pano_mvs.core.paths import stat_of
from pano_mvs.core.text import plural
from pano_mvs.engine.workflows.workflow import find_workflow
from pano_mvs.session.session import open_session, presets_folder

_INTERVAL_S = 0.5


def check_workflow(workflow: str, overrides: Sequence[str], images: Path | None) -> list[Path]:
    """Check a workflow, print that it has no mistakes, and return its files: YAML files and plugins.

    Raises:
        WorkflowError: with every mistake and its location.
        UsageError: if there is no such workflow.
        InputError: if a file or the images cannot be read.
    """
    session = open_session(workflow, overrides=overrides, images=images)
    for reason in session.workflow.left_out:
        Console(stderr=True).say(f"[yellow]warning:[/] {escape(reason)}")
    count = len(session.workflow.stages)
    Console().print(f"{escape(workflow)}: {count} {plural(count, 'stage')}, no mistakes", highlight=False)
    return [*session.workflow.files, *session.workflow.plugins]


def watch_workflow(
    workflow: str, overrides: Sequence[str], images: Path | None, *, sleep: Callable[[float], None] = time.sleep
) -> None:
    """Check a workflow now and after each change of its files, until the user interrupts.

    Args:
        sleep: waits between two looks at the files.

    Raises:
        UsageError: if there is no such workflow at the beginning.
    """
    files = [find_workflow(workflow, presets_folder())[0]]
    while True:
        before = _times(files)
        try:
            files = check_workflow(workflow, overrides, images) or files
            before = _times(files) | {path: before[path] for path in files if path in before}  # as they were checked
        except (WorkflowError, UsageError, InputError) as error:
            _print(error)
        while _times(files) == before:
            sleep(_INTERVAL_S)
        Console().say("")


def _times(files: Iterable[Path]) -> dict[Path, tuple[int, int] | None]:
    """Return the time stamp and the size of each file; None for one that is not there."""
    found = {path: stat_of(path) for path in files}
    return {path: None if known is None else (known.st_mtime_ns, known.st_size) for path, known in found.items()}


def _print(error: PanoMvsError) -> None:
    for problem in error.problems if isinstance(error, WorkflowError) else [str(error)]:
        Console(stderr=True).say(f"[red]error:[/] {escape(problem)}")
