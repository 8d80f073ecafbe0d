"""Divide the images of a capture into overlapping blocks, folders of links, and run a workflow over each.

A capture is divided without being asked if all images at once would take too much memory.
"""

from __future__ import annotations

import json
import os
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.blocks import divide_capture
from pano_mvs.core.errors import InputError, StoreError, UsageError
from pano_mvs.core.files import OUTPUT_MARK, read_regular, remove_whole, write_text
from pano_mvs.core.memory import size_text
from pano_mvs.core.paths import children, exists, is_folder, resolved
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.executors.choose import executor_size
from pano_mvs.engine.planning.forecast import Experience, expected_memory
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.engine.stages.params import files_of
from pano_mvs.io.images.captures import list_pictures
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_poses
from pano_mvs.results.summary import BLOCKS
from pano_mvs.scene import Poses
from pano_mvs.session.merging.merge import require_free
from pano_mvs.session.planning import reference_times
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session, check_output
from pano_mvs.session.summarise import chain_of


@dataclass(frozen=True)
class ImageBlock:
    """The images of one block."""

    folder: Path  # the folder of links
    names: tuple[str, ...]  # of the images, relative to it and to the capture


@dataclass(frozen=True)
class Division:
    """How a capture is divided."""

    size: int  # maximum number of images along the path in a block
    overlap: int  # number of images that consecutive blocks have in common
    loop: bool = False  # whether the path ends where it began
    # rough poses in any format that `read_poses` reads, to find where the path returns; None without
    poses: Path | None = None


def split_images(images: Path, to: Path, division: Division) -> list[ImageBlock]:
    """Divide a folder of images into blocks, and write a folder of links for each (block_1, block_2 …).

    Args:
        images: the folder of the capture, in natural order.
        to: folder to write to; new or empty.

    Raises:
        UsageError: if a setting or a folder cannot be used.
        InputError: if there are no images, or the poses are of other images.
        StoreError: if a link cannot be made.
    """
    if exists(to) and (not is_folder(to) or children(to)):
        raise UsageError(f"--out {to}: exists and is not an empty folder. Choose a new one")
    if resolved(images) in (resolved(to), *resolved(to).parents):
        raise UsageError(f"--out {to}: is in the folder of the images. Choose a folder elsewhere")
    return _link_blocks(images, to, _divide_images(images, division))


def _divide_images(images: Path, division: Division, *, ignored: Sequence[Path] = ()) -> list[tuple[str, ...]]:
    """Return the names of the images of each block, relative to the folder of the capture.

    Args:
        images: the folder of the capture, in natural order.
        ignored: files and folders in it that do not belong to the capture, such as masks.
    """
    names = tuple(path.relative_to(images).as_posix() for path in _pictures(images, ignored))
    positions = None if division.poses is None else _positions(division.poses, names)
    blocks = divide_capture(
        names, size=division.size, overlap=division.overlap, loop=division.loop, positions=positions
    )
    if len(blocks) == 1:
        raise UsageError(
            f"{images}: its {len(names)} images fit into one block of {division.size}. Run them without blocks"
        )
    return [tuple(block) for block in blocks]


def _pictures(images: Path, ignored: Sequence[Path]) -> list[Path]:
    left_out = [path.absolute() for path in ignored]
    found = list_pictures(images)
    return [path for path in found if not any(path.absolute().is_relative_to(place) for place in left_out)]


def _link_blocks(images: Path, to: Path, blocks: Sequence[Sequence[str]]) -> list[ImageBlock]:
    """Write a folder of links to the images of each block, and to their masks."""
    found = []
    for number, names in enumerate(blocks, start=1):
        folder = to / f"block_{number}"
        for name in names:
            _link(images / name, folder / name)
        if is_folder(images / "masks"):
            _link(images / "masks", folder / "masks")
        found.append(ImageBlock(folder, tuple(names)))
    return found


def _positions(poses: Path, names: tuple[str, ...]) -> Mapping[str, NDArray[np.float64]]:
    model = read_poses(poses)
    centers = dict(zip(model.names, model.centers, strict=True))
    found = {name: centers[known] for name, known in match_image_names(names, model.names).items()}
    if not found:
        raise InputError(f"{poses}: none of its images is one of this capture")
    return found


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.symlink_to(resolved(source))
    except OSError:  # as on Windows without the right to make symbolic links
        try:
            os.link(source, target)
        except OSError as error:
            raise StoreError(
                f"{target}: cannot be made a link to {source} ({error.strerror}). Choose --out on the same disk"
            ) from error


_SOURCE = "source.folder"


@dataclass(frozen=True)
class BlockRun:
    """A block that is to be run."""

    session: Session  # the workflow over its images
    names: tuple[str, ...]  # of its images, in the order of the capture
    folder: Path  # of all blocks; the block's output folder is in it
    number: int  # of the block, from 1
    blocks: int

    @property
    def name(self) -> str:
        """Name of the block, such as block_1: its output folder in that of all blocks."""
        return self.session.out.relative_to(self.folder).as_posix()


def divided(session: Session, division: Division) -> list[tuple[str, ...]]:
    """Return the images of the blocks into which the capture of a session is divided; nothing is written.

    Raises:
        UsageError: if the session cannot be run in blocks, or a setting cannot be used.
        InputError: if there are no images, or the rough poses are of other images.
    """
    check_output(session)
    require_free(session.out)
    require_mergeable(session)
    return _divide_images(_images(session), division, ignored=_ignored(session))


def pictures_of(session: Session) -> list[Path]:
    """Return the images of a capture that can be divided; none if it is not read from a folder of images.

    Raises:
        InputError: if the folder has no images.
    """
    entry = session.workflow.stages.get("images")
    return [] if entry is None or entry.spec.name != _SOURCE else _pictures(_images(session), _ignored(session))


def _ignored(session: Session) -> list[Path]:
    params = session.workflow.stages["images"].params
    return [path for name, paths in files_of(params).items() if name != "path" for path in paths]


_DIVISION = "division.json"


def earlier_division(out: Path) -> Division | None:
    """Return the division of an earlier run in blocks into an output folder; None without one."""
    try:
        value = json.loads(read_regular(out / BLOCKS / _DIVISION))
        poses = None if value["poses"] is None else Path(value["poses"])
        return Division(int(value["size"]), int(value["overlap"]), bool(value["loop"]), poses)
    except (OSError, ValueError, KeyError, TypeError):
        return None


@contextmanager
def open_blocks(session: Session) -> Iterator[Path]:
    """Make the folder of the blocks, `blocks` in the output folder of a session; no other run may use it meanwhile.

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
        yield folder


def remember_division(division: Division, out: Path) -> None:
    """Store the division of a run in blocks in its output folder, for `earlier_division`."""
    write_text(out / BLOCKS / _DIVISION, json.dumps(asdict(division), default=str))


def block_runs(
    session: Session, blocks: Sequence[tuple[str, ...]], folder: Path, *, within: str = ""
) -> list[BlockRun]:
    """Write the links to the images of the blocks below a folder, in place of earlier ones, and return the blocks.

    Args:
        session: over the whole capture.
        within: folder in it in which the links and the results are.

    Raises:
        StoreError: if a link cannot be made.
    """
    place = folder / within
    remove_whole(place / "images")
    linked = _link_blocks(_images(session), place / "images", blocks)
    return [
        BlockRun(_over(session, block.folder, place / block.folder.name), block.names, folder, number, len(linked))
        for number, block in enumerate(linked, start=1)
    ]


def first_poses(session: Session) -> Session:
    """Return the session limited to the first stage that makes poses."""
    workflow, graph = session.run_options.applied_to(session.workflow, session.graph)
    stage = chain_of(workflow, graph, Poses)[0]
    return replace(session, run_options=replace(session.run_options, until=(stage,)))


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


def require_mergeable(session: Session) -> None:
    """Check that a session can be run in blocks.

    Raises:
        UsageError: if it cannot.
    """
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


MIN_SIZE = 7  # smallest number of images of a block


def default_overlap(size: int) -> int:
    """Return the number of images that consecutive blocks of a size share unless it is given."""
    return min(100, max(3, size // 4))


@dataclass(frozen=True)
class BlockDecision:
    """Whether a run is divided into blocks."""

    division: Division | None = None  # how; None to run all images at once
    # how and why in one line, also if the capture should be divided and cannot be; "" if all images at once need no
    # explanation
    reason: str = ""


def decision_of(
    session: Session, execution: Execution, size: int | None, *, overlap: int, loop: bool, poses: Path | None
) -> BlockDecision:
    """Return the division that the options of `run` state, or without a size the one that `decide_blocks` finds.

    Args:
        size: maximum number of images of a block; 0 for no blocks; None to decide.
        overlap: images that consecutive blocks share; 0 for the default.

    Raises:
        UsageError: if the options do not fit together.
        InputError: if the file with the settings of the jobs cannot be read.
        WorkflowError: if it has mistakes.
    """
    if not size:
        given = {"--block-overlap": overlap, "--block-loop": loop, "--block-poses": poses}
        if names := [name for name, value in given.items() if value]:
            raise UsageError(f"{', '.join(names)}: only blocks have this. Give --block-size N as well")
        return decide_blocks(session, execution) if size is None else BlockDecision()
    if size < MIN_SIZE:
        raise UsageError(f"--block-size {size}: a block needs at least {MIN_SIZE} images")
    return BlockDecision(Division(size, overlap or default_overlap(size), loop, poses))


def decide_blocks(session: Session, execution: Execution) -> BlockDecision:
    """Return the division of the earlier run into the output folder, or else one that memory demands, or none.

    The memory of this machine, or that of a job of a queueing system, is compared with what the units for the whole
    capture are expected to need. Blocks are as large as memory permits. Nothing is divided for workers of a dask
    scheduler, whose memory is not known.

    Raises:
        InputError: if the file with the settings of the jobs cannot be read.
        WorkflowError: if it has mistakes.
    """
    if (earlier := earlier_division(session.out)) is not None:
        return BlockDecision(
            earlier, f"{session.out} holds blocks of at most {earlier.size} images, in which this run continues"
        )
    try:
        pictures = pictures_of(session)
    except InputError:  # which the run reports
        return BlockDecision()
    memory_bytes = _memory_bytes(execution)
    if not pictures or not memory_bytes:
        return BlockDecision()
    pixels = CaptureSize.of_files([(path,) for path in pictures]).pixels
    histories = (Store(session.store_root, for_reading=True).unit_times, reference_times())
    workflow, graph = session.run_options.applied_to(session.workflow, session.graph)

    def needed(images: int) -> tuple[float, str]:
        found = expected_memory(workflow, graph, Experience(CaptureSize(images, pixels), histories))
        return max(((needed_bytes, stage) for stage, needed_bytes in found.items()), default=(0.0, ""))

    count = len(pictures)
    most_bytes, stage = needed(count)
    if most_bytes <= memory_bytes:
        return BlockDecision()
    # Where the path returns, blocks get more images, about as many as they share with the next one.
    size = bisect_left(
        range(1, count), True, key=lambda images: needed(images + default_overlap(images))[0] > memory_bytes
    )
    takes = f"all at once, stage {stage} would take about {size_text(round(most_bytes))} of {size_text(memory_bytes)}"
    try:
        require_free(session.out)
        require_mergeable(session)
    except UsageError as error:
        return BlockDecision(reason=f"{takes} of memory, and the capture cannot be divided into blocks: {error}")
    if size < MIN_SIZE:
        return BlockDecision(reason=f"{takes} of memory, and even that of blocks of {MIN_SIZE} images would not do")
    division = Division(size, default_overlap(size))
    blocks = divide_capture([str(path) for path in pictures], size=size, overlap=division.overlap)
    largest = max(len(block) for block in blocks)
    return BlockDecision(
        division,
        f"{count:,} panoramas are run in {len(blocks)} blocks of at most {largest:,}, since {takes} of memory; "
        "--block-size 0 forbids it",
    )


def _memory_bytes(execution: Execution) -> int:
    """Return the memory of the machine that computes the units; 0 if unknown."""
    return executor_size(execution.request).memory_bytes
