"""Check and lay out workflows, as `pano-mvs check` and `pano-mvs fmt` do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import InputError, PanoMvsError, UsageError, WorkflowError
from pano_mvs.engine.workflows.formatted import formatted
from pano_mvs.session.python_calls import arguments_from_options, names_arguments, overrides_from_settings
from pano_mvs.session.session import open_session


@dataclass(frozen=True, slots=True)
class WorkflowCheck:
    """What is wrong with a workflow.

    Attributes:
        workflow: its name or path, as it was given.
        stages: number of its stages; 0 if it has mistakes.
        problems: all mistakes, each with its file, line and column; empty if it can run.
        warnings: what may not be intended.
    """

    workflow: str
    stages: int = 0
    problems: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there are no mistakes."""
        return not self.problems

    def to_json(self) -> dict[str, object]:
        """Return it as a JSON value."""
        return {
            "workflow": self.workflow,
            "ok": self.ok,
            "stages": self.stages,
            "problems": [*self.problems],
            "warnings": [*self.warnings],
        }


@names_arguments
def check(
    workflow: str | Path, images: str | Path | None = None, *, settings: Mapping[str, object] | None = None
) -> WorkflowCheck:
    """Return what is wrong with a workflow; nothing is computed or written.

    >>> import pano_mvs
    >>> pano_mvs.check("quality").problems
    ()
    >>> pano_mvs.check("quality", settings={"depth.plane": 64}).problems
    ("settings['depth.plane']: stage 'depth': unknown setting 'plane'. Did you mean 'planes'?",)

    Args:
        workflow: the name of a preset, or the path of a workflow file.
        images: a folder or video instead of those of the workflow.
        settings: `"STAGE.PARAM"` to a value, as in `run`.

    Raises:
        UsageError: if there is no such workflow, or an argument cannot be used.
    """
    overrides = overrides_from_settings(settings or {})
    try:
        session = open_session(workflow, overrides=overrides, images=images)
    except (WorkflowError, InputError) as error:
        return WorkflowCheck(str(workflow), problems=tuple(map(arguments_from_options, problems_of(error))))
    return WorkflowCheck(str(workflow), len(session.workflow.stages), warnings=tuple(session.workflow.warnings))


def problems_of(error: PanoMvsError) -> list[str]:
    """Return what is wrong, in lines: all mistakes of a workflow, or the one error."""
    return error.problems if isinstance(error, WorkflowError) else [str(error)]


_NOT_TEXT = "must be the text of a workflow file, such as Path(...).read_text()"


def format_workflow(text: str) -> str:
    r"""Return the text of a workflow file, laid out as the presets are; comments are kept.

    >>> import pano_mvs
    >>> pano_mvs.format_workflow('stages:\n  images: {path: "photos", use: source.folder}\n')
    'stages:\n  images: {use: source.folder, path: photos}\n'

    Raises:
        WorkflowError: if the text is not a YAML mapping, or has mistakes that leave open what it means.
        UsageError: if it is a path.
    """
    if not isinstance(text, str):
        raise UsageError(f"text {_NOT_TEXT}")
    if "\n" not in text and text.rstrip().endswith((".yaml", ".yml")):
        raise UsageError(f"text={text[:80]!r} is the name of a file: it {_NOT_TEXT}")
    return formatted(text, "text")
