"""`pano-mvs show`: print a workflow."""

from __future__ import annotations

from pano_mvs.core.text import without_controls
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.session.session import Session


def show_workflow(session: Session, *, resolved: bool) -> None:
    """Print the text of a workflow and of the files that it extends, or one file with all settings."""
    text = resolved_yaml(session.workflow, session.graph) if resolved else session.workflow.text
    print(without_controls(text).rstrip("\n"))
