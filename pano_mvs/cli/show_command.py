"""`pano-mvs show`: print a workflow."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.files import write_text
from pano_mvs.core.paths import exists
from pano_mvs.core.text import without_controls
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.session.session import Session


def show_workflow(session: Session, out: Path | None, *, resolved: bool) -> None:
    """Write the text of a workflow and of the files that it extends, or one file with all settings.

    Args:
        session: the workflow.
        out: the file; None for the standard output.
        resolved: whether to write one file with all settings.

    Raises:
        UsageError: if the file exists, or cannot be written.
    """
    text = resolved_yaml(session.workflow, session.graph) if resolved else session.workflow.text
    text = without_controls(text).rstrip("\n")
    if out is None:
        print(text)
        return
    if exists(out):
        raise UsageError(f"--out {out}: there is such a file already. Give a new name, or remove the file")
    try:
        write_text(out, f"{text}\n")
    except StoreError as error:
        raise UsageError(f"--out {error}") from error
    print(f"written to {out}")
