"""`pano-mvs vary`: run a workflow with each combination of settings, and compare the results in a table."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.commands import options_of_runs, takes_options
from pano_mvs.cli.completion import complete_setting
from pano_mvs.cli.console import Console, print_json
from pano_mvs.cli.endings import ending_text, guarded
from pano_mvs.cli.options import CacheOption, UntilOption, WorkflowArgument, takes_record
from pano_mvs.core.text import one_line, plural

if TYPE_CHECKING:
    from pano_mvs.session.progress import Event, Progress
    from pano_mvs_experiments.vary import Experiment, PlannedRun, PlannedUnits, VaryRequest
    from pano_mvs_experiments.vary_results import Variation, VariedRun

# Options by the panel of the help in which they are listed.
_result_option = partial(typer.Option, rich_help_panel="Results")
_worker_option = partial(typer.Option, rich_help_panel="Workers")


@dataclass(frozen=True)
class VaryArguments:
    """The arguments and options of `pano-mvs vary`."""

    workflow: WorkflowArgument
    images: Annotated[
        list[Path] | None,
        typer.Option(
            "--images",
            help="Folder of panoramas or of a virtual tour, or a video; can be repeated. Default: that of the "
            "workflow.",
        ),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Output folder; new, empty, or that of the same experiment. Default: out/vary."),
    ] = None
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="STAGE.PARAM=V1,V2",
            help="Values of a setting; all combinations are run. Brackets or quotes hold a value with commas together. "
            "Can be repeated; a setting with one value is the same in all runs.",
            autocompletion=complete_setting,
        ),
    ] = None
    file: Annotated[
        Path | None,
        typer.Option("--vary", metavar="FILE", help="YAML file with the combinations, under grid, list or random."),
    ] = None
    seeds: Annotated[
        int, typer.Option("--seeds", metavar="N", min=1, help="Number of seeds of the random numbers.")
    ] = 1
    cache: CacheOption = None
    until: UntilOption = None
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Number of worker processes; 0: one per core, if memory permits.")
    ] = 0
    dry_run: Annotated[
        bool, typer.Option("-n", "--dry-run", help="Only show the runs, and how many units each would compute.")
    ] = False
    metrics: Annotated[
        list[str] | None,
        _result_option(
            "--metric",
            metavar="STAGE.METRIC",
            help="A column of the table: a metric or a score of a stage, or registered, completeness, confirmed, "
            "points or seconds; can be repeated. Default: the scores if there is truth, else some of these.",
        ),
    ] = None
    best: Annotated[
        str,
        _result_option(
            "--best",
            metavar="STAGE.METRIC[:max|min]",
            help="Mark the best combination by this, if it is ahead of the second by more than the deviation over "
            "seeds.",
            show_default=False,
        ),
    ] = ""
    as_json: Annotated[bool, _result_option("--json", help="Print the results as JSON.")] = False
    stop: Annotated[
        bool, _worker_option("--stop", help="End after the first run that does not finish; default: go on.")
    ] = False
    keep_going: Annotated[
        bool,
        _worker_option("-k", "--keep-going", help="Continue runs after failures even if a stage has on_error: stop."),
    ] = False
    executor: Annotated[
        str,
        _worker_option(
            "--executor", help="How units are computed, as for `pano-mvs run`; default: processes.", show_default=False
        ),
    ] = ""
    threads: Annotated[
        int, _worker_option("--threads-per-worker", min=0, help="Threads per worker; 0: an equal share of the cores.")
    ] = 0


@takes_options(options_of_runs)
@guarded
@takes_record
def vary_settings(given: VaryArguments, options: Mapping[str, tuple[str, ...]] | None = None) -> None:
    """Run a workflow with each combination of settings, and compare the results; the same command resumes it."""
    from pano_mvs.cli.run.command import interrupted_by_termination
    from pano_mvs.session.observers import OBSERVERS
    from pano_mvs.session.running import Execution
    from pano_mvs_experiments.vary import Watch, planned_json, planned_units, prepare, run_experiment

    observers = {name: values for name, values in (options or {}).items() if name in OBSERVERS.names()}
    others = {name: values[0] for name, values in (options or {}).items() if name not in observers}
    execution = Execution(given.executor, given.workers, given.threads, options=others)
    experiment = prepare(_request(given))
    shown = Console(stderr=given.as_json)
    _print_counts(experiment, shown)
    if given.dry_run:
        planned = planned_units(experiment)
        if given.as_json:
            print_json(planned_json(experiment, planned))
        else:
            _print_plan(experiment, planned, shown)
        return
    watch = Watch(partial(_around, shown, len(experiment.runs)), partial(_print_end, shown))
    with interrupted_by_termination(), redirect_stdout(sys.stderr) if given.as_json else nullcontext():
        found = run_experiment(experiment, execution, watch, observers=observers, stop=given.stop)
    if given.as_json:
        print_json(found.to_json())
    else:
        print_variation(found, shown)
    raise typer.Exit(found.exit_code)


def _request(given: VaryArguments) -> VaryRequest:
    from pano_mvs.session.session import RunOptions
    from pano_mvs_experiments.grid import combinations_from_file, combinations_of_grid, grid_from_options
    from pano_mvs_experiments.vary import VaryRequest, combined

    values = grid_from_options(given.settings or [])
    varied = {target: each for target, each in values.items() if len(each) > 1}
    fixed = {target: each[0] for target, each in values.items() if len(each) == 1}
    combinations = combined(
        combinations_of_grid(varied) if varied else [],
        combinations_from_file(given.file) if given.file is not None else [],
    )
    combined([fixed], combinations)  # refuses what is set twice
    return VaryRequest(
        workflow=given.workflow,
        out=given.out or Path("out/vary"),
        images=tuple(given.images or ()),
        settings=fixed,
        combinations=combinations,
        seeds=given.seeds,
        metrics=tuple(given.metrics or ()),
        best=given.best,
        cache=given.cache,
        run_options=RunOptions(until=tuple(given.until or ()), keep_going=given.keep_going),
    )


def _print_counts(experiment: Experiment, console: Console) -> None:
    for name, other in experiment.dropped.items():
        console.say(f"note: {escape(name)} is left out, because it equals {escape(other)}")
    counts = [
        (len(experiment.combinations), "combination"),
        (len(experiment.captures), "capture"),
        (experiment.request.seeds, "seed"),
    ]
    total = len(experiment.runs)
    text = " × ".join(f"{count} {plural(count, what)}" for count, what in counts)
    console.say(f"{text}: {total} {plural(total, 'run')}")


def _print_plan(experiment: Experiment, planned: Sequence[PlannedUnits], console: Console) -> None:
    table = Table("capture", *map(escape, experiment.varied), "seed", "cached", "units to compute")
    for each in planned:
        combination = experiment.combinations[each.run.combination]
        values = [combination[target].shown if target in combination else "" for target in experiment.varied]
        cells = [each.run.capture, *values, str(each.run.seed), str(each.cached), each.shown]
        table.add_row(*map(escape, cells))
    console.show(table)
    total = sum(each.units for each in planned)
    bounds = {each.bound for each in planned}
    bound = "about " if "about" in bounds else "up to " if "up to" in bounds else ""
    console.say(f"{bound}{total} {plural(total, 'unit')} to compute; a unit that several runs need is counted once")


@contextmanager
def _around(console: Console, total: int, number: int, run: PlannedRun) -> Iterator[Progress]:
    from pano_mvs.cli.run.progress import ProgressDisplay

    console.say(f"\\[{number}/{total}] {escape(run.label)}")
    if not console.is_terminal:
        yield partial(_print_event, console)
        return
    with ProgressDisplay(console) as bars:
        yield bars


def _print_event(console: Console, event: Event) -> None:
    """Print what fails; the counts follow at the end of the run."""
    from pano_mvs.session.progress import UnitFailed, Warned

    if isinstance(event, Warned):
        console.say(f"  [yellow]warning:[/] {escape(event.text)}")
    elif isinstance(event, UnitFailed):
        label = f"{event.stage}:{event.item}" if event.item else event.stage
        console.say(f"  [red]failed:[/] {escape(one_line(label))}: {escape(event.cause)}")


def _print_end(console: Console, run: VariedRun) -> None:
    units = run.units
    failed = f", {units.failed} failed" if units.failed else ""
    counts = f"{units.run} {plural(units.run, 'unit')} computed, {units.cached} cached{failed}"
    code = run.exit_code or 0
    color = "green" if code == 0 else "yellow" if run.is_finished else "red"
    reason = f": {run.stopped}" if run.stopped else ""
    console.say(f"  [{color}]{escape(ending_text(code))}[/]{escape(reason)} ({counts})")


def print_variation(found: Variation, console: Console) -> None:
    """Print a table with a row for each combination, the failed runs, the best, and where the results are."""
    best = found.best.name if found.best is not None else ""
    table = Table(*map(escape, found.varied or ("combination",)), "exit code", *map(escape, found.metrics))
    for each in found.combinations:
        values = [each.settings.get(target, "") for target in found.varied] or [each.name]
        averages = (each.averages.get(name) for name in found.metrics)
        cells = ["–" if average is None else _shown(average, len(found.captures)) for average in averages]
        code = "not run" if each.exit_code is None else str(each.exit_code)
        table.add_row(*map(escape, [*values, code, *cells]), style="bold green" if best and each.name == best else "")
    console.show(table)
    if found.seeds > 1:
        console.say("±: standard deviation over seeds")
    for run in found.runs:
        if run.exit_code is not None and not run.is_finished:
            label = run.out.relative_to(found.out).as_posix()
            console.say(f"[red]not finished:[/] {escape(label)}: {escape(run.stopped or ending_text(run.exit_code))}")
    if found.best is not None:
        console.say(escape(found.best.text))
    for capture in found.disagreeing:
        own = found.by_capture[capture].best
        console.say(f"{escape(capture)} differs: {escape(own.text if own is not None else '')}")
    console.say(
        f"{found.computed} {plural(found.computed, 'unit')} computed; results in {escape(str(found.out / 'vary.html'))}"
    )


def _shown(average: object, captures: int) -> str:
    from pano_mvs_experiments.vary_results import Average

    assert isinstance(average, Average)
    return str(average) + (f" ({average.captures} of {captures})" if average.captures < captures else "")
