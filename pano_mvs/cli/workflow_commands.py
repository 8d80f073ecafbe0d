"""`pano-mvs show` and `schema`: print a workflow, or the JSON Schema of workflows for editors."""

from __future__ import annotations

import json
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_given
from pano_mvs.core.paths import exists
from pano_mvs.core.text import without_controls
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.extends import read_text
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.engine.workflows.schema import workflow_schema
from pano_mvs.engine.workflows.workflow import WorkflowReader, find_workflow
from pano_mvs.engine.workflows.yaml_text import Located
from pano_mvs.session.session import Session, presets_folder


def show_workflow(session: Session, out: Path | None, *, resolved: bool) -> None:
    """Write the text of a workflow and of the files that it extends, or one file with all settings."""
    text = resolved_yaml(session.workflow, session.graph) if resolved else session.workflow.text
    text = without_controls(text).rstrip("\n")
    if out is None:
        print(text)
        return
    if exists(out):
        raise UsageError(f"--out {out}: there is such a file already. Give a new name, or remove the file")
    write_given(out, f"{text}\n", f"--out {out}")
    print(f"written to {out}")


def show_schema(workflow: str | None, out: Path | None) -> None:
    """Write the schema of workflows to a file or to the standard output."""
    registry = Registry.installed()
    inherited = {} if workflow is None else _inherited(workflow, registry)
    text = json.dumps(workflow_schema(registry, inherited), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    write_given(out, text, f"--out {out}")
    hint = f"put this line at the top of a workflow: # yaml-language-server: $schema={out.as_posix()}"
    Console().say(escape(hint))


def _inherited(workflow: str, registry: Registry) -> dict[str, Located]:
    path, _ = find_workflow(workflow, presets_folder())
    reader = WorkflowReader(str(path), path.parent, registry, presets=presets_folder())
    return reader.inherited(read_text(path), path)
