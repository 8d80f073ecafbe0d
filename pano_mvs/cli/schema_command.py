"""`pano-mvs schema`: write the JSON Schema of workflows for editors."""

from __future__ import annotations

import json
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.files import write_text
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.extends import read_text
from pano_mvs.engine.workflows.schema import workflow_schema
from pano_mvs.engine.workflows.workflow import WorkflowReader, find_workflow
from pano_mvs.engine.workflows.yaml_text import Located
from pano_mvs.session.session import presets_folder


def show_schema(workflow: str | None, out: Path | None) -> None:
    """Write the schema of workflows to a file or to the standard output.

    Args:
        workflow: a workflow whose plugins and inherited stages are included.
        out: the file; None for the standard output.

    Raises:
        UsageError: if there is no such workflow, or the file cannot be written.
    """
    registry = Registry.installed()
    inherited = {} if workflow is None else _inherited(workflow, registry)
    text = json.dumps(workflow_schema(registry, inherited), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    try:
        write_text(out, text)
    except StoreError as error:
        raise UsageError(f"{error}") from error
    hint = f"put this line at the top of a workflow: # yaml-language-server: $schema={out.as_posix()}"
    Console().print(escape(hint), highlight=False, soft_wrap=True)


def _inherited(workflow: str, registry: Registry) -> dict[str, Located]:
    path, _ = find_workflow(workflow, presets_folder())
    reader = WorkflowReader(str(path), path.parent, registry, presets=presets_folder())
    return reader.inherited(read_text(path), path)
