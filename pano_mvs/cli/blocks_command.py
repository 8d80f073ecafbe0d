"""`pano-mvs run --block-size` and `merge`: divide a capture into blocks, run them, and merge them."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.plan_commands import show_dry_run
from pano_mvs.cli.run.command import interrupted_by_termination, run_shown, run_with_events, run_workflow
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.core.text import plural
from pano_mvs.engine.running.events import Warned
from pano_mvs.results.summary import BLOCKS
from pano_mvs.session.captures import is_early, run_blocks, run_in_blocks
from pano_mvs.session.merging.block_runs import BlockDecision, BlockRun, block_runs, decide_blocks, divided
from pano_mvs.session.merging.merge import merge_outputs
from pano_mvs.session.progress import Divided, Event, RunFinished
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session, run_command

_SAME_COMMAND = "give the same command again; finished results are reused"


def run_decided(
    session: Session,
    execution: Execution,
    decision: BlockDecision,
    *,
    as_json: bool = False,
    dry_run: bool = False,
    advise: bool = True,
) -> int:
    """Run a workflow, in blocks if that was decided, print progress and a summary, and return the exit code.

    Args:
        advise: whether to print the commands that can follow.
    """
    if decision.division is not None:
        return _run_blocks_shown(session, execution, decision, as_json=as_json, dry_run=dry_run)
    if decision.reason:
        Console(stderr=True).say(f"[yellow]warning:[/] {escape(decision.reason)}")
    if dry_run:
        show_dry_run(session, Console(), execution=execution, as_json=as_json)
        return 0
    return run_workflow(session, execution, as_json=as_json, advise=advise)


def run_capture(session: Session) -> int:
    """Run a workflow as `pano-mvs run` does without options, in blocks if memory demands it; return the exit code.

    Commands that can follow are not printed.
    """
    execution = Execution()
    return run_decided(session, execution, decide_blocks(session, execution), advise=False)


def _run_blocks_shown(
    session: Session, execution: Execution, decision: BlockDecision, *, as_json: bool, dry_run: bool
) -> int:
    """Run a workflow for each block of its images, merge the blocks, and return the exit code.

    A block that ends early ends the command, or, with `--keep-going`, is left for a later command. The blocks are
    merged when none did.
    """
    if dry_run:
        if as_json:
            raise UsageError("--dry-run prints a table, not events: leave out --json")
        show_blocks(session, decision, Console(), show=partial(show_dry_run, execution=execution, as_json=False))
        return 0
    if as_json:
        return _run_with_events(session, execution, decision)
    console, codes = Console(), dict[str, int]()

    def run_block(run: BlockRun) -> int:
        _print_heading(run, console=console)
        try:
            summary = run_shown(run.session, execution, console, advise=False)
            code, reason = summary.exit_code, summary.stopped
        except PanoMvsError as error:
            code, reason = error.exit_code, str(error)
        if is_early(code):
            Console(stderr=True).say(
                f"[red]error:[/] {run.name}: {escape(reason)}\n"
                f"To continue, remove the cause and {_SAME_COMMAND}. This block alone:\n"
                f"  {escape(run_command(run.session))}"
            )
        codes[run.name] = code
        return code

    with interrupted_by_termination():
        merge = partial(_merge, session=session, console=console)
        progress = execution.observed(partial(_print_event, console))
        code = run_blocks(session, decision, run_block=run_block, merge=merge, progress=progress)
    early = [name for name, ended in codes.items() if is_early(ended)]
    if early and session.run_options.keep_going:
        console.print(f"not merged, because {', '.join(early)} did not finish. To continue, {_SAME_COMMAND}")
    return code


def _run_with_events(session: Session, execution: Execution, decision: BlockDecision) -> int:
    """Run and merge blocks, print all events, and return the exit code, that of the last event."""
    codes = [1]

    def watch(event: Event) -> None:
        if isinstance(event, RunFinished):
            codes.append(event.exit_code)

    run_with_events(lambda progress: run_in_blocks(session, execution, decision, progress=progress), watch)
    return codes[-1]


def _print_event(console: Console, event: Event) -> None:
    if isinstance(event, Warned):
        console.say(f"[yellow]warning:[/] {escape(event.text)}")
    elif isinstance(event, Divided):
        console.say(escape(event.reason))


def _print_heading(run: BlockRun, *, console: Console) -> None:
    what = ", rough poses" if run.session.out.parent != run.folder else ""
    console.say(
        f"\n[bold]block {run.number} of {run.blocks}[/]{what}: {len(run.names)} images, "
        f"{escape(run.names[0])} to {escape(run.names[-1])}, in {escape(str(run.session.out))}"
    )


def _merge(outs: Sequence[Path], *, session: Session, console: Console) -> int:
    console.print(f"\n[bold]merging {len(outs)} blocks[/] into {escape(str(session.out))}", highlight=False)
    try:
        return merge_blocks_command(tuple(outs), session.out, cache=session.store_root, console=console)
    except PanoMvsError as error:
        Console(stderr=True).say(
            f"[red]error:[/] {escape(str(error))}\nAll blocks have run; their results are in "
            f"{escape(str(outs[0].parent))}. Look at their reports; other settings or a larger --block-overlap may "
            f"help. To continue, {_SAME_COMMAND}"
        )
        return error.exit_code


def show_blocks(
    session: Session, decision: BlockDecision, console: Console, *, show: Callable[[Session, Console], object]
) -> None:
    """Print why a capture is divided, and the plan of each block with the results that are cached now.

    Args:
        session: over the whole capture.
        decision: with a division.
    """
    assert decision.division is not None
    if decision.reason:
        console.say(escape(decision.reason))
    divisions = divided(session, decision.division)
    with tempfile.TemporaryDirectory() as folder:
        for run in block_runs(session, divisions, Path(folder)):
            blocks = session.out / BLOCKS
            shown = replace(run, session=replace(run.session, out=blocks / run.name), folder=blocks)
            _print_heading(shown, console=console)
            show(shown.session, console)


def merge_blocks_command(outs: tuple[Path, ...], to: Path, *, cache: Path | None, console: Console) -> int:
    """Merge output folders, print how well they agree and what was written, and return the exit code."""
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
