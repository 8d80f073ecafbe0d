"""`pano-mvs fmt`: lay out workflow files."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console, print_json
from pano_mvs.core.files import write_given
from pano_mvs.core.paths import resolved
from pano_mvs.engine.workflows.formatted import formatted
from pano_mvs.engine.workflows.workflow_file import read_text


def format_workflows(paths: Sequence[Path], console: Console, *, check: bool, show: bool, as_json: bool = False) -> int:
    """Lay out workflow files, and return 0, or 4 if `check` or `show` is set and a file is not laid out.

    Args:
        check: whether to change no file.
        show: whether to print what would change, and to change no file.
        as_json: whether to print one JSON object instead: which files were not laid out as usual.
    """
    texts = {path: read_text(path).replace("\r\n", "\n") for path in paths}
    laid_out = {path: formatted(text, str(path)) for path, text in texts.items()}  # all, before one is written
    changed = []
    for path, made in laid_out.items():
        text = texts[path]
        if made == text:
            continue
        changed.append(path)
        if show:
            lines = difflib.unified_diff(
                text.splitlines(), made.splitlines(), str(path), f"{path} laid out", lineterm=""
            )
            console.say(escape("\n".join(lines)))
        elif not check:
            _write(path, made)
    code = 4 if changed and (check or show) else 0
    if as_json:
        print_json({"files": [{"file": str(path), "changed": path in changed} for path in paths], "written": not check})
        return code
    for path in changed:
        console.say(f"{escape(str(path))}: {'is not laid out as usual' if check or show else 'was laid out'}")
    if not changed:
        console.say(f"{len(paths)} laid out as usual already" if len(paths) > 1 else "laid out as usual already")
    return code


def _write(path: Path, text: str) -> None:
    """Replace a file, through links, with the line ends and the permissions that it has."""
    place = resolved(path)
    mode, ends = place.stat().st_mode, "\r\n" if b"\r\n" in place.read_bytes() else "\n"
    write_given(place, text.replace("\n", ends), str(path))
    place.chmod(mode)
