"""`pano-mvs fmt`: lay out workflow files."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.files import write_given
from pano_mvs.engine.workflows.formatted import formatted
from pano_mvs.engine.workflows.workflow_file import read_text


def format_workflows(paths: Sequence[Path], console: Console, *, check: bool, show: bool) -> int:
    """Lay out workflow files, and return 0, or 4 if `check` or `show` is set and a file is not laid out.

    Args:
        check: whether to change no file.
        show: whether to print what would change, and to change no file.
    """
    changed = []
    for path in paths:
        text = read_text(path)
        made = formatted(text, str(path))
        if made == text:
            continue
        changed.append(path)
        if show:
            lines = difflib.unified_diff(
                text.splitlines(), made.splitlines(), str(path), f"{path} laid out", lineterm=""
            )
            console.say(escape("\n".join(lines)))
        elif not check:
            write_given(path, made, str(path))
    for path in changed:
        console.say(f"{escape(str(path))}: {'is not laid out as usual' if check or show else 'was laid out'}")
    if not changed:
        console.say(f"{len(paths)} laid out as usual already" if len(paths) > 1 else "laid out as usual already")
    return 4 if changed and (check or show) else 0
