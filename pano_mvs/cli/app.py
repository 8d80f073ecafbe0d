"""The command line: parse options, call the function that does the work, return its exit code.

0 ok · 1 internal error · 2 usage or validation · 3 finished with failed items · 4 stopped by a threshold or a check ·
130 interrupted.
"""

from __future__ import annotations

import faulthandler
import os
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from pano_mvs import __version__
from pano_mvs.cli.cache_commands import cache_app
from pano_mvs.cli.commands import PluginGroup, options_of_runs, takes_options
from pano_mvs.cli.console import Console
from pano_mvs.cli.doctor.command import doctor
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import (
    AcceptOption,
    CacheOption,
    ImagesOption,
    KeepOption,
    OnlyOption,
    OutOption,
    RefreshOption,
    SetOption,
    TargetArgument,
    UntilOption,
    WorkflowArgument,
    takes_record,
)
from pano_mvs.cli.plugins.app import plugin_app, plugins, stage_app
from pano_mvs.cli.streams import protect_standard_streams
from pano_mvs.engine.executors.threads import available_threads, bound_environment

app = typer.Typer(
    name="pano-mvs",
    cls=PluginGroup,
    help="Dense 3D from 360° photographs.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(stage_app, name="stage")
app.add_typer(plugin_app, name="plugin")
app.add_typer(cache_app, name="cache")


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"pano-mvs {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Dense 3D from 360° photographs."""


# Options by the panel of the help in which they are listed.
_worker_option = partial(typer.Option, rich_help_panel="Workers")
_disk_option = partial(typer.Option, rich_help_panel="Disk and messages")
_block_option = partial(typer.Option, rich_help_panel="Blocks of a large capture")


@dataclass(frozen=True)
class RunArguments:
    """The arguments and options of `pano-mvs run`."""

    workflow: WorkflowArgument
    images: ImagesOption = None
    out: OutOption = None
    overrides: SetOption = None
    cache: CacheOption = None
    executor: Annotated[
        str,
        _worker_option(
            "--executor",
            help="How units are computed: processes, serial (one unit at a time in this process, for debugging), or "
            "an executor of a plugin, such as dask or slurm. Default: processes.",
            show_default=False,
        ),
    ] = ""
    workers: Annotated[
        int,
        typer.Option("--workers", min=0, help="Number of worker processes; 0: one per core, if memory permits."),
    ] = 0
    threads: Annotated[
        int, _worker_option("--threads-per-worker", min=0, help="Threads per worker; 0: an equal share of the cores.")
    ] = 0
    as_json: Annotated[bool, typer.Option("--json", help="Print events instead, one JSON object per line.")] = False
    until: UntilOption = None
    only: OnlyOption = None
    refresh: RefreshOption = None
    accept_code: AcceptOption = False
    keep_going: Annotated[
        bool, typer.Option("-k", "--keep-going", help="Continue after failures even if a stage has on_error: stop.")
    ] = False
    isolate: Annotated[
        bool, _worker_option("--isolate", help="Compute each unit of a plugin's stage in a process of its own.")
    ] = False
    min_free: Annotated[
        str,
        _disk_option(
            "--min-free",
            metavar="SIZE",
            help="Stop if less disk space than this is free for the cache, such as 5GB; default: 200MB.",
            show_default=False,
        ),
    ] = ""
    durable: Annotated[
        bool, _disk_option("--durable", help="Flush each result to disk, for machines that may lose power.")
    ] = False
    keep: KeepOption = None
    dry_run: Annotated[
        bool, typer.Option("-n", "--dry-run", help="Only show what would be computed, as `pano-mvs plan` does.")
    ] = False
    block_size: Annotated[
        int | None,
        _block_option(
            "--block-size",
            metavar="N",
            min=0,
            help="Run overlapping blocks of at most N images one after the other, and merge them; 0: all images at "
            "once. Default: blocks if pairs or poses would take more memory than there is.",
            show_default=False,
        ),
    ] = None
    block_overlap: Annotated[
        int,
        _block_option(
            "--block-overlap",
            metavar="N",
            min=0,
            help="Images that consecutive blocks share; default: a quarter of the block size, 3 to 100.",
            show_default=False,
        ),
    ] = 0
    block_loop: Annotated[
        bool, _block_option("--block-loop", help="The path ends where it began: the last block overlaps the first.")
    ] = False
    block_poses: Annotated[
        Path | None,
        _block_option(
            "--block-poses", help="Rough poses, such as an output folder: blocks also overlap where the path returns."
        ),
    ] = None


@app.command()
@takes_options(options_of_runs)
@guarded
@takes_record
def run(given: RunArguments, options: Mapping[str, tuple[str, ...]] | None = None) -> None:
    """Run a workflow; the same command resumes it."""
    from pano_mvs.cli.blocks_command import run_decided
    from pano_mvs.engine.planning.plan import RunOptions
    from pano_mvs.session.merging.block_runs import decision_of
    from pano_mvs.session.observers import OBSERVERS, observing
    from pano_mvs.session.running import Execution
    from pano_mvs.session.session import open_session

    limits = tuple(given.until or ()), tuple(given.only or ()), tuple(given.refresh or ())
    run_options = RunOptions(*limits, given.accept_code, given.keep_going, given.isolate, given.keep == "all")
    session = open_session(
        given.workflow,
        overrides=given.overrides or [],
        images=given.images,
        cache=given.cache,
        out=given.out,
        run_options=run_options,
    )
    observers = {name: values for name, values in (options or {}).items() if name in OBSERVERS.names()}
    execution = Execution(
        given.executor,
        given.workers,
        given.threads,
        options={name: ("", *values)[-1] for name, values in (options or {}).items() if name not in observers},
        min_free=given.min_free,
        durable=given.durable,
    )
    with observing({} if given.dry_run else observers, session.out) as observed:
        execution = replace(execution, observers=observed)
        decision = decision_of(
            session,
            execution,
            given.block_size,
            overlap=given.block_overlap,
            loop=given.block_loop,
            poses=given.block_poses,
        )
        code = run_decided(session, execution, decision, as_json=given.as_json, dry_run=given.dry_run)
    raise typer.Exit(code)


@app.command()
@guarded
def plan(
    workflow: WorkflowArgument,
    images: ImagesOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    cache: CacheOption = None,
    until: UntilOption = None,
    only: OnlyOption = None,
    refresh: RefreshOption = None,
    accept_code: AcceptOption = False,
    keep: KeepOption = None,
    explain: Annotated[
        str,
        typer.Option(
            "--explain",
            metavar="STAGE:ITEM",
            help="Describe one unit: its inputs, its cache key, and where its result is stored.",
            show_default=False,
        ),
    ] = "",
    by_stage: Annotated[
        bool, typer.Option("--stages", help="List each stage; default: one row for each group of stages.")
    ] = False,
) -> None:
    """Show what a run would compute, and why; nothing is written to the output folder."""
    from pano_mvs.cli.blocks_command import show_blocks
    from pano_mvs.cli.plan_commands import explain_unit, show_plan
    from pano_mvs.engine.planning.plan import RunOptions
    from pano_mvs.session.merging.block_runs import decide_blocks
    from pano_mvs.session.running import Execution
    from pano_mvs.session.session import check_output, open_session

    limits = tuple(until or ()), tuple(only or ()), tuple(refresh or ())
    run_options = RunOptions(*limits, accept_code, keep_all=keep == "all")
    session = open_session(
        workflow, overrides=overrides or [], images=images, cache=cache, out=out, run_options=run_options
    )
    check_output(session)
    if explain:
        explain_unit(session, explain, Console())
        return
    decision = decide_blocks(session, Execution())
    if decision.division is not None:
        show_blocks(session, decision, Console(), show=partial(show_plan, by_stage=by_stage))
        return
    if decision.reason:
        Console(stderr=True).say(f"[yellow]warning:[/] {escape(decision.reason)}")
    show_plan(session, Console(), by_stage=by_stage)


@app.command()
@guarded
def check(
    workflow: WorkflowArgument,
    images: ImagesOption = None,
    overrides: SetOption = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Check again after each change of its files, until Ctrl-C.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print the mistakes and warnings as JSON; with --watch, each check on a line."),
    ] = False,
) -> None:
    """Check a workflow and report every mistake with its line and column."""
    from pano_mvs.cli.check_command import check_workflow, print_checked, watch_workflow

    if watch:
        watch_workflow(workflow, overrides or [], images, as_json=as_json)
    elif as_json:
        print_checked(workflow, overrides or [], images)
    else:
        check_workflow(workflow, overrides or [], images)


@app.command("fmt")
@guarded
def format_files(
    files: Annotated[list[Path], typer.Argument(metavar="WORKFLOW...", help="Workflow files.")],
    check_only: Annotated[
        bool, typer.Option("--check", help="Change no file; exit code 4 if one is not laid out.")
    ] = False,
    show_diff: Annotated[bool, typer.Option("--diff", help="Print what would change, and change no file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print which files have changed, or would, as JSON.")] = False,
) -> None:
    """Lay out workflow files: order of keys, one line for a stage where it fits, no needless quotes, all comments."""
    from pano_mvs.cli.format_command import format_workflows

    if as_json and show_diff:
        from pano_mvs.core.errors import UsageError

        raise UsageError("--diff and --json cannot be combined: use one of them")
    raise typer.Exit(format_workflows(files, Console(), check=check_only, show=show_diff, as_json=as_json))


@app.command()
@guarded
def schema(
    workflow: Annotated[
        str | None,
        typer.Argument(
            metavar="[WORKFLOW]", help="Include the plugins of this workflow and the stages that it inherits."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write; default: standard output.")] = None,
) -> None:
    """Write the JSON Schema of workflows, for completion and validation in editors."""
    from pano_mvs.cli.plan_commands import show_schema

    show_schema(workflow, out)


@app.command()
@guarded
def show(
    workflow: WorkflowArgument,
    resolved: Annotated[
        bool,
        typer.Option("--resolved", help="Merge all files into one workflow, with every setting and its value."),
    ] = False,
    text: Annotated[
        bool, typer.Option("--text", help="Print the workflow and the files that it extends and uses, as they are.")
    ] = False,
    images: ImagesOption = None,
    overrides: SetOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="File for the text, or for the result of --resolved.")
    ] = None,
) -> None:
    """Print the groups of stages of a workflow, its text, or one file with all settings."""
    from pano_mvs.cli.plan_commands import show_workflow
    from pano_mvs.session.session import open_session

    session = open_session(workflow, overrides=overrides or [], images=images)
    show_workflow(session, out, resolved=resolved, text=text)


@app.command()
@guarded
def status(
    target: TargetArgument,
    images: ImagesOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    cache: CacheOption = None,
) -> None:
    """Show what the latest run did and what is cached now."""
    from pano_mvs.cli.plan_commands import show_status

    show_status(target, out, overrides=overrides or [], images=images, cache=cache, console=Console())


@app.command("watch")
@guarded
def watch_output(out: Annotated[Path, typer.Argument(metavar="OUT", help="The output folder of a run.")]) -> None:
    """Follow a run that another terminal or host has started, until it ends; exit with its exit code."""
    from pano_mvs.cli.watch_command import watch_run

    raise typer.Exit(watch_run(out, Console()))


@app.command()
@guarded
def report(out: Annotated[Path, typer.Argument(help="The output folder of a run.")], cache: CacheOption = None) -> None:
    """Rewrite report.html from run.json and the cache, without computing anything."""
    from pano_mvs.cli.report_command import rewrite_report

    rewrite_report(out, cache, Console())


app.command()(plugins)
app.command()(doctor)


@app.command("scale", context_settings={"ignore_unknown_options": True})
@guarded
def scale_results(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The output folder of a run.")],
    known: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[A B LENGTH]",
            help="Two images, or two points x,y,z, and the distance between them, such as 3.42m, 342cm or 11.2ft.",
        ),
    ] = None,
    camera_height: Annotated[
        str,
        typer.Option(
            "--camera-height", metavar="LENGTH", help="Height of the cameras above the floor.", show_default=False
        ),
    ] = "",
    group: Annotated[
        int, typer.Option("--group", min=0, help="Group of the poses in which points or the height were measured.")
    ] = 0,
    cache: CacheOption = None,
) -> None:
    """Put a run into metres by a measured length; without one, print what a usual camera height would give."""
    from pano_mvs.cli.scale_command import scale_output

    code = scale_output(
        out, tuple(known or ()), camera_height=camera_height, group=group, cache=cache, console=Console()
    )
    raise typer.Exit(code)


@app.command("split")
@guarded
def split_capture(
    images: Annotated[Path, typer.Argument(metavar="IMAGES", help="The folder of the capture, in natural order.")],
    to: Annotated[Path, typer.Option("--out", help="Folder to write the blocks to.")],
    size: Annotated[int, typer.Option("--size", min=7, help="Maximum number of images of a block.")] = 2000,
    overlap: Annotated[int, typer.Option("--overlap", min=3, help="Images that consecutive blocks share.")] = 100,
    loop: Annotated[bool, typer.Option("--loop", help="The path ends where it began.")] = False,
    poses: Annotated[
        Path | None,
        typer.Option(
            "--poses", help="Rough poses, such as an output folder: blocks also overlap where the path returns."
        ),
    ] = None,
) -> None:
    """Divide a capture into overlapping blocks: folders of links to its images."""
    from pano_mvs.session.merging.block_runs import Division, split_images

    console, blocks = Console(), split_images(images, to, Division(size, overlap, loop, poses))
    outs = [f"out/{block.folder.name}" for block in blocks]
    for block, out in zip(blocks, outs, strict=True):
        console.say(
            f"{escape(str(block.folder))}: {len(block.names)} images\n"
            f"  pano-mvs run WORKFLOW --images {escape(shlex.quote(str(block.folder)))} --out {out}"
        )
    console.say(f"then: pano-mvs merge {' '.join(outs)} --out out/merged")


@app.command("merge")
@guarded
def merge_runs(
    outs: Annotated[list[Path], typer.Argument(metavar="OUT...", help="The output folders of the blocks.")],
    to: Annotated[Path, typer.Option("--out", help="Folder to write the merged results to.")],
    cache: CacheOption = None,
) -> None:
    """Merge runs over overlapping blocks of a capture: poses, points, cloud and range maps."""
    from pano_mvs.cli.blocks_command import merge_blocks_command

    raise typer.Exit(merge_blocks_command(tuple(outs), to, cache=cache, console=Console()))


@app.command("inspect")
@guarded
def inspect_pixel(
    target: TargetArgument,
    image: Annotated[str, typer.Argument(help="Name of the image, or a unique part of it.")],
    x: Annotated[
        float,
        typer.Argument(
            help="Column of the pixel, from the left, at the resolution of the sweep; fractions are dropped."
        ),
    ],
    y: Annotated[float, typer.Argument(help="Row of the pixel, from the top.")],
    stage: Annotated[
        str, typer.Option("--stage", help="Sweep stage to inspect; default: the first.", show_default=False)
    ] = "",
    overrides: SetOption = None,
    images: ImagesOption = None,
    cache: CacheOption = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Folder with poses.json and depth.npz; default: that of the workflow."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Write a plot of the cost curve to this file.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Analyse one pixel: its ray, its range after each stage, and its cost for every depth hypothesis."""
    from pano_mvs.cli.inspect_command import PixelWanted, inspect
    from pano_mvs.session.session import reopen

    session = reopen(target, overrides=overrides or [], images=images, cache=cache)
    inspect(session, PixelWanted(image, x, y, stage, truth), Console(), plot=plot, as_json=as_json)


def main() -> None:
    """Run the command line."""
    bound_environment(os.environ, available_threads())  # before a command loads the libraries
    output = protect_standard_streams()
    faulthandler.enable(os.dup(2))  # a stage in this process may redirect descriptor 2
    try:
        app()
    except SystemExit as end:
        sys.stdout.flush()
        sys.exit(output.exit_code(end.code) if isinstance(end.code, int) else end.code)
