"""`pano-mvs run --block-size`, `split` and `merge`: divide a capture into blocks, run them, and merge them."""

from __future__ import annotations

import shlex
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.plan_commands import show_dry_run
from pano_mvs.cli.run.command import interrupted_by_termination, run_shown
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.core.text import plural
from pano_mvs.results.summary import BLOCKS, FAILED_ITEMS, INTERRUPTED
from pano_mvs.session.commands import run_command
from pano_mvs.session.event_log import EventLog
from pano_mvs.session.merging.block_runs import BlockRun, Division, block_runs, divided, open_blocks, split_images
from pano_mvs.session.merging.merge import merge_outputs
from pano_mvs.session.progress import BlockStarted, Event, RunFinished, Warned
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session

_MIN_SIZE = 7
_SAME_COMMAND = "give the same command again; finished results are reused"


def division_of(size: int, overlap: int, *, loop: bool, poses: Path | None) -> Division | None:
    """Return the division that the options of `run` state, or None without blocks.

    Args:
        size: maximum number of images of a block; 0 for no blocks.
        overlap: images that consecutive blocks share; 0 for a quarter of the size, between 3 and 100.
        loop: whether the path ends where it began.
        poses: rough poses.

    Raises:
        UsageError: if the options do not fit together.
    """
    if size == 0:
        given = {"--block-overlap": overlap, "--block-loop": loop, "--block-poses": poses}
        if names := [name for name, value in given.items() if value]:
            raise UsageError(f"{', '.join(names)}: only blocks have this. Give --block-size N as well")
        return None
    if size < _MIN_SIZE:
        raise UsageError(f"--block-size {size}: a block needs at least {_MIN_SIZE} images")
    return Division(size, overlap or min(100, max(3, size // 4)), loop, poses)


def run_in_blocks(
    session: Session, execution: Execution, division: Division, *, as_json: bool = False, dry_run: bool = False
) -> int:
    """Run a workflow for each block of its images, merge the blocks, and return the exit code.

    A block that ends early ends the command, or, with `--keep-going`, is left for a later command. The blocks are
    merged when none did.

    Raises:
        UsageError: if the session cannot be run in blocks, or an option does not go with blocks.
        InputError: if there are no images.
        StoreError: if the output folder cannot be written.
    """
    if as_json:
        raise UsageError(
            "--json reports one run, and each block is a run. Divide the capture with pano-mvs split, and give --json "
            "to the run of each block"
        )
    console = Console()
    blocks = divided(session, division)
    if dry_run:
        _show_dry_run(session, execution, blocks, console=console)
        return 0
    with interrupted_by_termination(), open_blocks(session, blocks) as runs:
        log, began, code = EventLog(partial(_print_warning, console)), time.monotonic(), 1
        log.open(session.out / BLOCKS)
        try:
            code = _run_and_merge(session, execution, runs, log=log, console=console)
            return code
        except KeyboardInterrupt:
            code = INTERRUPTED
            raise
        finally:
            log(RunFinished(code, "", seconds=round(time.monotonic() - began, 3), out=session.out))


def _print_warning(console: Console, event: Event) -> None:
    if isinstance(event, Warned):
        console.say(f"[yellow]warning:[/] {escape(event.text)}")


def _run_and_merge(
    session: Session, execution: Execution, runs: Sequence[BlockRun], *, log: EventLog, console: Console
) -> int:
    codes = []
    for number, run in enumerate(runs, start=1):
        left = sum(len(later.names) for later in runs[number:])
        log(BlockStarted(run.name, number, len(runs), images=len(run.names), images_left=left))
        _print_heading(run, number, len(runs), console=console)
        code = _run_block(run, execution, console)
        codes.append(code)
        if _is_early(code) and not session.run_options.keep_going:
            return code
    if early := [run.name for run, code in zip(runs, codes, strict=True) if _is_early(code)]:
        console.print(f"not merged, because {', '.join(early)} did not finish. To continue, {_SAME_COMMAND}")
        return max(filter(_is_early, codes))
    merged = _merge(session, runs, console)
    return merged if _is_early(merged) else max(*codes, merged)


def _is_early(code: int) -> bool:
    """Return whether a run with an exit code ended before it was finished."""
    return code not in (0, FAILED_ITEMS)


def _print_heading(run: BlockRun, number: int, count: int, *, console: Console) -> None:
    console.say(
        f"\n[bold]block {number} of {count}[/]: {len(run.names)} images, "
        f"{escape(run.names[0])} to {escape(run.names[-1])}, in {escape(str(run.session.out))}"
    )


def _run_block(run: BlockRun, execution: Execution, console: Console) -> int:
    """Run a block and return its exit code; if it ends early, print why and how to go on."""
    try:
        summary = run_shown(run.session, execution, console, advise=False)
        code, reason = summary.exit_code, summary.stopped
    except PanoMvsError as error:
        code, reason = error.exit_code, str(error)
    if _is_early(code):
        Console(stderr=True).say(
            f"[red]error:[/] {run.name}: {escape(reason)}\n"
            f"To continue, remove the cause and {_SAME_COMMAND}. This block alone:\n"
            f"  {escape(run_command(run.session))}"
        )
    return code


def _merge(session: Session, runs: Sequence[BlockRun], console: Console) -> int:
    console.print(f"\n[bold]merging {len(runs)} blocks[/] into {escape(str(session.out))}", highlight=False)
    outs = tuple(run.session.out for run in runs)
    try:
        return merge_blocks_command(outs, session.out, cache=session.store_root, console=console)
    except PanoMvsError as error:
        Console(stderr=True).say(
            f"[red]error:[/] {escape(str(error))}\nAll blocks have run; their results are in "
            f"{escape(str(outs[0].parent))}. Look at their reports; other settings or a larger --block-overlap may "
            f"help. To continue, {_SAME_COMMAND}"
        )
        return error.exit_code


def _show_dry_run(
    session: Session, execution: Execution, blocks: Sequence[tuple[str, ...]], *, console: Console
) -> None:
    """Print the plan of each block as it would be with the results that are cached now; nothing is written."""
    with tempfile.TemporaryDirectory() as folder:
        for number, run in enumerate(block_runs(session, blocks, Path(folder)), start=1):
            shown = replace(run, session=replace(run.session, out=session.out / BLOCKS / run.name))
            _print_heading(shown, number, len(blocks), console=console)
            show_dry_run(shown.session, execution, console, as_json=False)


def split_command(images: Path, to: Path, division: Division, *, console: Console) -> None:
    """Write the blocks of a capture, and print them and the commands that follow.

    Raises:
        UsageError: if a setting or a folder cannot be used.
        InputError: if there are no images, or the poses are of other images.
        StoreError: if a link cannot be made.
    """
    blocks = split_images(images, to, division)
    outs = [f"out/{block.folder.name}" for block in blocks]
    for block, out in zip(blocks, outs, strict=True):
        console.say(
            f"{escape(str(block.folder))}: {len(block.names)} images\n"
            f"  pano-mvs run WORKFLOW --images {escape(shlex.quote(str(block.folder)))} --out {out}"
        )
    console.say(f"then: pano-mvs merge {' '.join(outs)} --out out/merged")


def merge_blocks_command(outs: tuple[Path, ...], to: Path, *, cache: Path | None, console: Console) -> int:
    """Merge output folders, print how well they agree and what was written, and return the exit code.

    Raises:
        UsageError: if the folders cannot be used.
        InputError: if the blocks cannot be merged.
        StoreError: if a file cannot be written.
    """
    with console.status("merging"):
        summary = merge_outputs(outs, to, cache=cache).summary
    for text in summary.notes:
        console.say(escape(text))
    for text in summary.warnings:
        console.say(f"warning: {escape(text)}")
    if count := len(summary.rejected):
        name, why = next(iter(summary.rejected.items()))
        text = f"{count} {plural(count, 'image')} without a pose, such as {name}: {why.reason}"
        console.say(escape(text))
    points = f", cloud of {summary.cloud.points:,} points" if summary.cloud.points else ""
    console.say(
        f"{len(summary.poses.registered)} cameras, {summary.poses.points:,} sparse points, {len(summary.views)} range "
        f"maps{points}\nreport: {escape(str(to / 'report.html'))}\n"
        f"next:\n  {escape(shlex.join(['pano-mvs', 'view', str(to)]))}"
    )
    return summary.exit_code
