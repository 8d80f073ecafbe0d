"""Decide whether a capture is run in blocks without being asked: if all at once would take too much memory."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.algorithms.blocks import divide_capture
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.memory import size_text, total_memory_bytes
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.executors.queues import read_queue
from pano_mvs.engine.planning.forecast import expected_memory
from pano_mvs.session.merging.block_runs import Division, earlier_division, pictures_of, require_mergeable
from pano_mvs.session.merging.merge import require_free
from pano_mvs.session.planning import reference_times
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session

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
        found = expected_memory(workflow, graph, size=CaptureSize(images, pixels), histories=histories, threads=1)
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
    if execution.queue is not None:
        return read_queue(execution.queue).memory_bytes
    return 0 if execution.scheduler else total_memory_bytes()
