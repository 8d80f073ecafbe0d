"""A session: a wired workflow with its cache and its output folder, and the command lines that continue from it."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pano_mvs
from pano_mvs.core.errors import InputError, UsageError, WorkflowError
from pano_mvs.core.paths import exists, is_denied, is_file, is_folder, problem_of, resolved
from pano_mvs.engine.planning.plan import DEFAULT_OPTIONS as DEFAULT_OPTIONS  # these are passed on
from pano_mvs.engine.planning.plan import RunOptions as RunOptions
from pano_mvs.engine.stages.params import files_of
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.wiring import Graph, wire, wiring_problems
from pano_mvs.engine.workflows.workflow import InvalidWorkflowError, Workflow, find_workflow, load_workflow
from pano_mvs.io.images.captures import UNSTITCHED_SUFFIXES, unstitched_reason
from pano_mvs.io.readers import capture_reader_of
from pano_mvs.results.summary import CACHE_VARIABLE, RunSummary, cache_of


@dataclass(frozen=True, slots=True)
class Session:
    """A workflow, ready to be planned or run."""

    workflow: Workflow
    graph: Graph
    registry: Registry
    store_root: Path
    out: Path
    run_options: RunOptions = DEFAULT_OPTIONS


_FOLDER_SOURCE = "source.folder"


def presets_folder() -> Path:
    """Return the folder of the shipped workflows: inside the installed package, or beside it in a checkout."""
    package = Path(pano_mvs.__file__).parent
    inside = package / "workflows"
    return inside if is_folder(inside) else package.parent / "workflows"


def _images_mistake(images: Path) -> str:
    """Return why a path is neither a folder of images nor a video; "" if it is one."""
    if is_folder(images):
        return ""
    if not exists(images):
        denied = f"cannot be read ({problem_of(images)})" if is_denied(images) else "there is no such folder or video"
        return f"--images {images}: {denied}"
    if images.suffix.lower() in UNSTITCHED_SUFFIXES:
        return f"--images {images}: this is {unstitched_reason(images)}"
    if capture_reader_of(images) is None:
        return f"--images {images}: this is a file; give the folder that contains the images, or a video"
    return ""


def open_session(
    name: str | Path,
    *,
    overrides: Sequence[str] = (),
    images: str | Path | None = None,
    cache: str | Path | None = None,
    out: str | Path | None = None,
    run_options: RunOptions = DEFAULT_OPTIONS,
    on_file: Callable[[Path], None] = lambda _: None,
) -> Session:
    """Find, validate and wire a workflow.

    If `images` holds another kind of capture that a plugin reads, such as a virtual tour, its source takes the place of
    source.folder with the settings that both have, unless `overrides` name a source.

    The store is `cache`, else $PANO_MVS_CACHE, else `.pano-mvs` beside the workflow file (in the current folder for a
    preset given by name). The output folder is `out`, else `out/<workflow name>` in the current folder.
    `on_file` is called with each file of the workflow before it is read, and with those that are missing.

    Raises:
        UsageError: if there is no such workflow.
        WorkflowError: with every mistake in it.
        InputError: if the folder of images, or the video, does not exist or cannot be used.
        UsageError: if a stage reads the folder of the cache.
    """
    path, is_preset = find_workflow(str(name), presets_folder())
    if images == "":
        raise InputError("--images: the name of the folder is empty. Give the folder that holds the panoramas")
    images = None if images is None else Path(images)
    registry = Registry.installed()  # whose files may bring readers of captures
    mistake = None if images is None else _images_mistake(images)
    try:
        workflow = load_workflow(
            path, registry, overrides=overrides, images=images, presets=presets_folder(), on_file=on_file
        )
    except InvalidWorkflowError as error:
        own = f"--images {images}: "  # said by the mistake already
        found = [*error.problems, *wiring_problems(error.stages, error.unknown)]
        others = [problem for problem in found if not (mistake and problem.startswith(own))]
        if not others:
            raise InputError(mistake) from None
        raise WorkflowError([*([mistake] if mistake else []), *others]) from None
    if mistake:
        raise InputError(mistake)
    if images is not None and (added := _source_overrides(images, workflow, registry, overrides=overrides)):
        overrides = [*added, *overrides]
        workflow = load_workflow(path, registry, overrides=overrides, images=images, presets=presets_folder())
    # The files of the user's plugin folder go along to the workers as well, which need not have it.
    named = {resolved(path) for path in workflow.plugins}
    behind = registry.files_behind({entry.spec.name for entry in workflow.stages.values()})
    workflow = replace(
        workflow,
        plugins=dict(workflow.plugins) | {path: digest for path, digest in behind.items() if path not in named},
    )
    graph = wire(workflow)
    root = Path(cache) if cache else default_cache(path, is_preset=is_preset)
    session = Session(workflow, graph, registry, root, Path(out or default_out(workflow.name)), run_options)
    if name := _reader_of(root, session):
        option = "--cache" if cache or not os.environ.get(CACHE_VARIABLE) else f"${CACHE_VARIABLE}"
        raise UsageError(
            f"{option} {root}: stage {name!r} reads this folder, and the cache's files would be "
            "among its own. Choose another folder"
        )
    return session


def _source_overrides(images: Path, workflow: Workflow, registry: Registry, *, overrides: Sequence[str]) -> list[str]:
    """Return what makes the source that reads a capture the stage of images, with the settings that both have.

    Nothing is needed for a folder of panoramas, or if the workflow or an override names a source.

    Raises:
        InputError: if the workflow needs more than another source.
    """
    entry, reader = workflow.stages["images"], capture_reader_of(images)
    if reader is None or reader.source == entry.spec.name:
        return []
    if reader.advice:
        if is_folder(images):
            return []
        raise InputError(f"--images {images}: this is {reader.what}. {reader.advice}")
    chosen = any(override.partition("=")[0].strip() == "images.use" for override in overrides)
    spec = registry.stages.get(reader.source)
    if chosen or spec is None or entry.spec.name != _FOLDER_SOURCE:
        return []
    shared = spec.params_type.model_fields.keys() & type(entry.params).model_fields.keys() - {"path"}
    return [
        f"images.use={reader.source}",
        *(f"images.{name}={json.dumps(getattr(entry.params, name))}" for name in sorted(shared)),
    ]


def default_cache(workflow: Path, *, is_preset: bool) -> Path:
    """Return the cache of a workflow file: $PANO_MVS_CACHE, or `.pano-mvs` beside it, or for presets here."""
    return Path(os.environ.get(CACHE_VARIABLE) or (resolved(Path()) if is_preset else workflow.parent) / ".pano-mvs")


def default_out(workflow_name: str) -> Path:
    """Return the output folder of a workflow: `out/NAME` in the current folder."""
    return Path("out") / workflow_name


def check_output(session: Session) -> None:
    """Refuse an output folder from which a stage reads.

    Raises:
        UsageError: if a stage reads it.
    """
    if name := _reader_of(session.out, session):
        raise UsageError(f"--out {session.out}: stage {name!r} reads this folder. Choose another folder")


def _reader_of(folder: Path, session: Session) -> str:
    """Return the stage whose settings name a folder; "" if there is none."""
    place = resolved(folder)
    for name, entry in session.workflow.stages.items():
        if any(resolved(path) == place for paths in files_of(entry.params).values() for path in paths):
            return name
    return ""


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
        f"images.path={folder if isinstance(folder, str) else json.dumps(folder)}"
        if one.startswith("images.path=") and folder
        else one
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
