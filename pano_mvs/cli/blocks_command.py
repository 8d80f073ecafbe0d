"""`pano-mvs run --block-size`: run a workflow block by block, and merge the blocks."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.merge_command import merge_blocks_command
from pano_mvs.cli.plan_commands import show_dry_run
from pano_mvs.cli.run.command import interrupted_by_termination, run_shown
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.session.commands import run_command
from pano_mvs.session.merging.block_runs import BlockRun, Division, block_runs, divided, open_blocks
from pano_mvs.session.merging.merge import BLOCKS
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session

_MIN_SIZE = 7
_FAILED_ITEMS = 3
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
        codes = []
        for number, run in enumerate(runs, start=1):
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
    return code not in (0, _FAILED_ITEMS)


def _print_heading(run: BlockRun, number: int, count: int, *, console: Console) -> None:
    console.print(
        f"\n[bold]block {number} of {count}[/]: {len(run.names)} images, "
        f"{escape(run.names[0])} to {escape(run.names[-1])}, in {escape(str(run.session.out))}",
        highlight=False,
        soft_wrap=True,
    )


def _run_block(run: BlockRun, execution: Execution, console: Console) -> int:
    """Run a block and return its exit code; if it ends early, print why and how to go on."""
    try:
        summary = run_shown(run.session, execution, console, advise=False)
        code, reason = summary.exit_code, summary.stopped
    except PanoMvsError as error:
        code, reason = error.exit_code, str(error)
    if _is_early(code):
        Console(stderr=True).print(
            f"[red]error:[/] {run.name}: {escape(reason)}\n"
            f"To continue, remove the cause and {_SAME_COMMAND}. This block alone:\n"
            f"  {escape(run_command(run.session))}",
            highlight=False,
            soft_wrap=True,
        )
    return code


def _merge(session: Session, runs: Sequence[BlockRun], console: Console) -> int:
    console.print(f"\n[bold]merging {len(runs)} blocks[/] into {escape(str(session.out))}", highlight=False)
    outs = tuple(run.session.out for run in runs)
    try:
        return merge_blocks_command(outs, session.out, cache=session.store_root, console=console)
    except PanoMvsError as error:
        Console(stderr=True).print(
            f"[red]error:[/] {escape(str(error))}\nAll blocks have run; their results are in "
            f"{escape(str(outs[0].parent))}. Look at their reports; other settings or a larger --block-overlap may "
            f"help. To continue, {_SAME_COMMAND}",
            highlight=False,
            soft_wrap=True,
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
