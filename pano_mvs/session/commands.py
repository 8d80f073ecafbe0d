"""Command lines that continue from a session, as messages print them, and sessions of earlier runs."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder, resolved
from pano_mvs.engine.workflows.workflow import find_workflow
from pano_mvs.results.summary import RunSummary, cache_of
from pano_mvs.session.session import Session, default_cache, default_out, open_session, presets_folder


def run_command(session: Session, *options: str) -> str:
    """Return the `pano-mvs run` of a session: its workflow, images, settings, output folder and cache.

    It can be pasted in the current folder.
    """
    name, is_preset = _workflow_word(session)
    words = ["pano-mvs", "run", name]
    for override in session.workflow.overrides:
        setting, _, value = override.partition("=")
        # --images is stored as a setting, but in its original form, which may not be valid YAML.
        folder = _folder_of_images(session, value) if setting == "images.path" else ""
        words += ["--images", folder] if folder else ["--set", override]
    if resolved(session.out) != resolved(default_out(session.workflow.name)):
        words += ["--out", str(session.out)]
    path = session.workflow.path
    if path is None or resolved(session.store_root) != resolved(default_cache(path, is_preset=is_preset)):
        words += ["--cache", str(session.store_root)]
    return shlex.join([*words, *options])


def reopen(target: str, *, overrides: Sequence[str], images: Path | None, cache: Path | None) -> Session:
    """Open a workflow, or that of an output folder with the settings, images and cache of its run.

    Args:
        target: a workflow file, the name of a preset, or an output folder.
        images: folder of panoramas; None for that of the run, or of the workflow.
        cache: folder of the cache; None for that of the run, or the default.

    Raises:
        UsageError: if there is no such workflow or folder.
        InputError: if the folder has no run.json, its workflow file is missing, or it is merged from blocks.
    """
    out = Path(target)
    if not is_folder(out):
        try:
            find_workflow(target, presets_folder())
        except UsageError as error:
            raise UsageError(f"there is no output folder {target[:80]!r}, and {error}") from error
        return open_session(target, overrides=overrides, images=images, cache=cache)
    summary = RunSummary.read(out)
    if summary.merged is not None:
        raise InputError(
            f"{out} is merged from blocks, each of which is a run of its own. Give a block: "
            f"{', '.join(summary.merged.blocks)}"
        )
    workflow = Path(summary.workflow.path)
    if not is_file(workflow):
        raise InputError(f"{out}: its workflow {workflow} is missing. Give another workflow in place of the folder")
    # A relative folder is relative to where the run was started; the settings contain the absolute path.
    folder = next((stage.params.get("path") for stage in summary.stages if stage.name == "images"), None)
    given = [
        f"images.path={json.dumps(folder)}" if one.startswith("images.path=") and folder else one
        for one in summary.workflow.overrides
    ]
    if cache is None and summary.cache:
        cache = cache_of(summary)
    return open_session(str(workflow), overrides=[*given, *overrides], images=images, cache=cache, out=out)


def _workflow_word(session: Session) -> tuple[str, bool]:
    """Return how a command line names a workflow, and whether this is the name of a preset."""
    path = session.workflow.path
    if path is None:
        return session.workflow.name, False
    try:
        found, is_preset = find_workflow(path.stem, presets_folder())
    except UsageError:
        return str(path), False
    return (path.stem, True) if is_preset and resolved(found) == resolved(path) else (str(path), False)


def _folder_of_images(session: Session, given: str) -> str:
    """Return the folder of panoramas as it was given if that is possible, else its path; empty if it is not one."""
    if is_folder(Path(given)):
        return given
    path = getattr(session.workflow.stages["images"].params, "path", None)
    return str(path) if isinstance(path, Path) and is_folder(path) else ""
