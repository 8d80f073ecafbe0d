"""Run a workflow in overlapping blocks of its images: one session for each block, in the output folder of the whole."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.files import OUTPUT_MARK, remove_whole
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.engine.stages.params import files_of
from pano_mvs.scene import Poses
from pano_mvs.session.final_stages import chain_of
from pano_mvs.session.merging.merge import BLOCKS, require_free
from pano_mvs.session.merging.split import Division, divide_images, link_blocks
from pano_mvs.session.session import Session, check_output

_SOURCE = "source.folder"


@dataclass(frozen=True)
class BlockRun:
    """A block that is to be run.

    Attributes:
        session: the workflow over its images.
        names: of its images, in the order of the capture.
    """

    session: Session
    names: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the block, such as block_1."""
        return self.session.out.name


def divided(session: Session, division: Division) -> list[tuple[str, ...]]:
    """Return the images of the blocks into which the capture of a session is divided; nothing is written.

    Raises:
        UsageError: if the session cannot be run in blocks, or a setting cannot be used.
        InputError: if there are no images, or the rough poses are of other images.
    """
    check_output(session)
    require_free(session.out)
    _require_mergeable(session)
    params = session.workflow.stages["images"].params
    ignored = [path for name, paths in files_of(params).items() if name != "path" for path in paths]
    return divide_images(_images(session), division, ignored=ignored)


@contextmanager
def open_blocks(session: Session, blocks: Sequence[tuple[str, ...]]) -> Iterator[list[BlockRun]]:
    """Write the links to the images of the blocks, and yield the blocks; no other command may run them meanwhile.

    The links and the output folders are in `blocks` in the output folder of the session. Links of an earlier division
    are replaced; results stay.

    Raises:
        StoreError: if another run holds the folder, or it cannot be written.
    """
    folder = session.out / BLOCKS
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (session.out / OUTPUT_MARK).touch()
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written ({error.strerror}). Choose another folder with --out") from error
    with output_lock(folder):
        remove_whole(folder / "images")
        yield block_runs(session, blocks, folder)


def block_runs(session: Session, blocks: Sequence[tuple[str, ...]], folder: Path) -> list[BlockRun]:
    """Write the links to the images of the blocks below a folder, and return the blocks.

    Raises:
        StoreError: if a link cannot be made.
    """
    linked = link_blocks(_images(session), folder / "images", blocks)
    return [BlockRun(_over(session, block.folder, folder / block.folder.name), block.names) for block in linked]


def _over(session: Session, images: Path, out: Path) -> Session:
    """Return the session with other images and another output folder."""
    workflow = session.workflow
    entry = workflow.stages["images"]
    params = entry.params.model_copy(update={"path": images.absolute()})
    overrides = [text for text in workflow.overrides if not text.startswith("images.path=")]
    changed = replace(
        workflow,
        stages={**workflow.stages, "images": replace(entry, params=params)},
        overrides=(f"images.path={images}", *overrides),
    )
    return replace(session, workflow=changed, out=out)


def _images(session: Session) -> Path:
    path = getattr(session.workflow.stages["images"].params, "path", None)
    assert isinstance(path, Path)  # of source.folder
    return path


def _require_mergeable(session: Session) -> None:
    entry = session.workflow.stages.get("images")
    if entry is None or entry.spec.name != _SOURCE:
        use = "no stage of this name" if entry is None else entry.spec.name
        raise UsageError(
            f"--block-size divides a folder of images, which the stage images reads with {_SOURCE}; this workflow has "
            f"{use}. Extract the frames of a video first, and use --set images.use={_SOURCE} --images FRAMES"
        )
    options = session.run_options
    if options.only or any(":" in unit for unit in options.refresh):
        raise UsageError(
            "--only and --refresh STAGE:ITEM name units of one run, and each block is a run. Give them to the run of a "
            f"block: --images {session.out / BLOCKS / 'images' / 'block_1'} --out {session.out / BLOCKS / 'block_1'}"
        )
    workflow, graph = options.applied_to(session.workflow, session.graph)
    if not chain_of(workflow, graph, Poses):
        until = f" --until {options.until[0]}" if options.until else ""
        raise UsageError(f"--block-size{until}: blocks are merged by their poses, and no stage of the run makes poses")
