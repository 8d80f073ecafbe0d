"""Run a workflow over a capture: all images at once, or in blocks that are merged."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pano_mvs.core.errors import InputError, PanoMvsError
from pano_mvs.engine.cache.dropping import dropping_after
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.running.events import Warned, ignore
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.summary import FAILED_ITEMS, INTERRUPTED
from pano_mvs.session.merging.block_runs import (
    BlockDecision,
    BlockRun,
    Division,
    block_runs,
    decide_blocks,
    decision_of,
    divided,
    earlier_division,
    first_poses,
    open_blocks,
    remember_division,
)
from pano_mvs.session.merging.merge import merge_outputs
from pano_mvs.session.observers import observing
from pano_mvs.session.progress import BlockStarted, Divided, EventLog, Progress, RunFinished
from pano_mvs.session.python_calls import as_names, names_arguments, overrides_from_settings
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.session import Session, open_session


@names_arguments
def run(
    workflow: str | Path,
    images: str | Path | None = None,
    out: str | Path | None = None,
    *,
    settings: Mapping[str, object] | None = None,
    cache: str | Path | None = None,
    executor: str | Execution = "",
    workers: int | None = None,
    until: str | Sequence[str] = (),
    only: str | Sequence[str] = (),
    refresh: str | Sequence[str] = (),
    keep_going: bool = False,
    keep: Literal["all"] | None = None,
    progress: Progress | None = None,
    observers: Mapping[str, str | Sequence[str]] | None = None,
    block_size: int | None = None,
    block_overlap: int = 0,
    block_loop: bool = False,
    block_poses: str | Path | None = None,
) -> RunOutput:
    """Run a workflow and return its output; cached results are reused.

    Units that fail do not raise an error: they are in `summary.failures`, and `summary.ok` is False. The same holds
    for a quality threshold that stops the run (`summary.stopped`).

    Without `images`, presets run on their samples:

    >>> import pano_mvs
    >>> run = pano_mvs.run("quickstart", out="out", settings={"depth.planes": 96})
    >>> run.ok, run.summary.poses.registered
    (True, ('000.png', '001.png', '002.png', '003.png'))
    >>> run.views["000.png"].range_map.shape
    (512, 1024)

    Args:
        workflow: name of a preset, or a workflow file.
        images: folder of panoramas; None for that of the workflow.
        out: output folder; None for out/<name of the workflow> in the current folder.
        settings: `STAGE.PARAM` to a Python value, or to a string in the syntax of `--set`.
        cache: folder of the cache; None for $PANO_MVS_CACHE, or else `.pano-mvs` beside the workflow file (in the
            current folder if the workflow is a preset).
        executor: `processes` (the default), `serial` (in this process, for debugging) or that of a plugin, such as
            `dask`; or an `Execution`, for other settings, such as those of a queueing system.
        workers: number of units at a time; None for one per core, if memory permits.
        until: run only these stages, or groups of stages, and those that they need. One name may be given as a text,
            as for `only` and `refresh`.
        only: run only these units, as `STAGE:ITEM`, and those that they need.
        refresh: stages, groups or units to recompute even if they are cached.
        keep_going: continue after failures even if a stage has `on_error: stop`.
        keep: "all" to keep the results of temporary stages in the cache, too; None to drop them when nothing reads them
            any more.
        progress: called with each event of `pano_mvs.session.progress`; an exception that it raises ends the run.
        observers: name of each observer of a plugin that is to receive the events, to the values of its option, such
            as `{"otel": (), "notify": ["ntfy://topic"]}`.
        block_size: run overlapping blocks of at most this number of images, and merge them; 0 to run all images at
            once. None: in blocks if pairs or poses would take more memory than there is. If the run of a block ends
            early, its output is returned.
        block_overlap: images that consecutive blocks share; 0 for a quarter of the block size, between 3 and 100.
        block_loop: whether the path ends where it began, so that the last block overlaps the first one.
        block_poses: rough poses, with which blocks also overlap where the path returns.

    Raises:
        UsageError: if the workflow, a setting or a folder cannot be used.
        InputError: if the images cannot be read.
        StoreError: if the cache or the output folder cannot be written.
    """
    run_options = RunOptions(
        as_names(until), as_names(only), as_names(refresh), keep_going=keep_going, keep_all=keep == "all"
    )
    session = open_session(
        workflow,
        overrides=overrides_from_settings(settings or {}),
        images=images,
        cache=cache,
        out=out,
        run_options=run_options,
    )
    execution = executor if isinstance(executor, Execution) else Execution(executor)
    execution = replace(execution, workers=workers or execution.workers)
    poses = None if block_poses is None else Path(block_poses)
    decision = decision_of(session, execution, block_size, overlap=block_overlap, loop=block_loop, poses=poses)
    wanted = {name: as_names(values) for name, values in (observers or {}).items()}
    return run_open_session(session, execution, decision, observers=wanted, progress=progress or ignore)


def run_open_session(
    session: Session,
    execution: Execution,
    decision: BlockDecision | None = None,
    *,
    observers: Mapping[str, tuple[str, ...]],
    progress: Progress = ignore,
) -> RunOutput:
    """Run an open session over its capture, in blocks if that was decided, and return its output; see `run`.

    Args:
        decision: whether to run in blocks; None for blocks if pairs or poses would take more memory than there is.
        observers: name of each observer that receives the events, to the values of its option, () for a flag.

    Raises:
        UsageError: if the session cannot be run with this execution or these observers.
        InputError: if the images cannot be read.
        StoreError: if the cache or the output folder cannot be written.
    """
    if decision is None:
        decision = decide_blocks(session, execution)
    with observing(observers, session.out) as observed:
        execution = replace(execution, observers=observed)
        if decision.division is not None:
            return run_in_blocks(session, execution, decision, progress=progress)
        if decision.reason:
            progress(Warned(decision.reason))
        return run_session(session, execution, progress)


def run_in_blocks(session: Session, execution: Execution, decision: BlockDecision, *, progress: Progress) -> RunOutput:
    """Run a workflow for each block of its images, merge the blocks, and return the merged output.

    If the run of a block ends early, its output is returned.

    Args:
        decision: with a division.

    Raises:
        UsageError: if the session cannot be run in blocks.
        InputError: if there are no images, or the blocks cannot be merged.
        StoreError: if the cache or the output folder cannot be written.
    """
    outputs: list[RunOutput] = []

    def run_block(block: BlockRun) -> int:
        outputs.append(run_session(block.session, execution, progress))
        return outputs[-1].summary.exit_code

    def merge(outs: Sequence[Path]) -> int:
        return merge_outputs(outs, session.out, cache=session.store_root).summary.exit_code

    run_blocks(session, decision, run_block=run_block, merge=merge, progress=execution.observed(progress))
    early = [output for output in outputs if is_early(output.summary.exit_code)]
    return early[0] if early else load(session.out, cache=session.store_root)


def run_blocks(
    session: Session,
    decision: BlockDecision,
    *,
    run_block: Callable[[BlockRun], int],
    merge: Callable[[Sequence[Path]], int],
    progress: Progress,
) -> int:
    """Run the blocks of a capture one after the other, merge them if all have finished, and return the exit code.

    Without rough poses, the poses of the blocks are solved first, and the blocks are divided again by these. Events of
    the blocks and of the end are also written to `blocks/logs/events.jsonl`.

    Args:
        session: over the whole capture.
        decision: with a division.
        run_block: runs a block, and returns its exit code. One that ends early ends all, unless `keep_going` is set.
        merge: merges the output folders of the blocks, and returns the exit code.
        progress: receives the events of the blocks and of the end, not those of their runs.

    Raises:
        UsageError: if the session cannot be run in blocks.
        InputError: if there are no images.
        StoreError: if the output folder cannot be written.
    """
    assert decision.division is not None
    divided(session, decision.division)
    with open_blocks(session) as folder:
        log, began, end = EventLog(progress), time.monotonic(), RunFinished(1, "internal error", out=session.out)
        log.open(folder)
        try:
            if decision.reason:
                log(Divided(decision.reason))
            with dropping_after([session.store_root]):  # blocks share images
                code = _run_and_merge(_Blocks(session, folder, run_block, log), decision.division, merge)
            end = replace(end, exit_code=code, stopped="")
            return code
        except PanoMvsError as error:
            end = replace(end, exit_code=error.exit_code, stopped=str(error))
            raise
        except KeyboardInterrupt:
            end = replace(end, exit_code=INTERRUPTED, stopped="interrupted")
            raise
        finally:
            log(replace(end, seconds=round(time.monotonic() - began, 3)))


@dataclass(frozen=True)
class _Blocks:
    """How the blocks of a capture are run."""

    session: Session
    folder: Path
    run_block: Callable[[BlockRun], int]
    log: Progress

    def run(self, runs: Sequence[BlockRun]) -> list[int]:
        """Run blocks, and return their exit codes; one that ends early is the last, unless `keep_going` is set."""
        codes = list[int]()
        for run in runs:
            left = sum(len(later.names) for later in runs[run.number :])
            self.log(BlockStarted(run.name, run.number, run.blocks, images=len(run.names), images_left=left))
            codes.append(self.run_block(run))
            if is_early(codes[-1]) and not self.session.run_options.keep_going:
                break
        return codes


def _run_and_merge(blocks: _Blocks, division: Division, merge: Callable[[Sequence[Path]], int]) -> int:
    session = blocks.session
    earlier = earlier_division(session.out)
    if division.poses is None and earlier is not None and replace(earlier, poses=None) == division:
        division = earlier
    if division.poses is None:
        division, code = _with_rough_poses(blocks, division)
        if is_early(code):
            return code
    remember_division(division, session.out)
    runs = block_runs(session, divided(session, division), blocks.folder)
    codes = blocks.run(runs)
    if early := [code for code in codes if is_early(code)]:
        return max(early)
    merged = merge([run.session.out for run in runs])
    return merged if is_early(merged) else max(*codes, merged)


_ROUGH = "rough"


def _with_rough_poses(blocks: _Blocks, division: Division) -> tuple[Division, int]:
    """Solve the poses of blocks, and return the division with these as rough poses, and the exit code.

    With them, blocks overlap where the path returns to the place of another block. Otherwise the blocks would drift
    apart there, since no image would be in both.
    """
    session = first_poses(blocks.session)
    runs = block_runs(session, divided(session, division), blocks.folder, within=_ROUGH)
    if early := [code for code in blocks.run(runs) if is_early(code)]:
        return division, max(early)
    merged = blocks.folder / _ROUGH / "merged"
    try:
        merge_outputs([run.session.out for run in runs], merged, cache=session.store_root)
    except InputError:  # later stages may correct the poses; otherwise the last merge reports it
        return division, 0
    return replace(division, poses=merged.absolute()), 0


def is_early(exit_code: int) -> bool:
    """Return whether a run with an exit code ended before it was finished."""
    return exit_code not in (0, FAILED_ITEMS)
