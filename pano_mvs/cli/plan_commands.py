"""`pano-mvs plan`, `status`, `show` and `schema`: what a run would compute and did, and its workflow."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_verdict
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.files import write_given
from pano_mvs.core.kernel_cache import must_compile
from pano_mvs.core.memory import size_text
from pano_mvs.core.paths import exists, is_file, is_folder
from pano_mvs.core.text import duration_text, plural, shortened_list, without_controls
from pano_mvs.core.yaml_text import Located
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.executors.choose import executor_size
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.planning.plan import RunOptions, StagePlan, make_plan
from pano_mvs.engine.planning.units import Unit, UnitInput
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.editor_schema import workflow_schema
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.engine.workflows.workflow import Workflow, WorkflowReader, find_workflow
from pano_mvs.engine.workflows.workflow_file import read_text
from pano_mvs.results.summary import RUN_JSON, RunSummary
from pano_mvs.session.planning import RunPlan, plan_session
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session, check_output, presets_folder, reopen, run_command

_SHOWN_REASONS = 5


def show_dry_run(session: Session, console: Console, *, execution: Execution, as_json: bool) -> None:
    """Print the plan of a run, for its number of workers."""
    if as_json:
        raise UsageError("--dry-run prints a table, not events: leave out --json")
    check_output(session)
    size = executor_size(execution.request)
    show_plan(session, console, workers=size.workers, threads=size.threads)


def show_plan(
    session: Session, console: Console, *, workers: int = 0, threads: int = 0, by_stage: bool = False
) -> RunPlan:
    """Print for each group of stages the units that are cached and that would or may run, with times, and the reasons.

    Args:
        workers: number of units at a time, for the times; 0 for the default.
        threads: of each worker; 0 for the default.
        by_stage: whether each stage has a row of its own, also those in groups.
    """
    run_plan = plan_session(session, workers=workers, threads=threads)
    console.print(_table(run_plan, {} if by_stage else run_plan.groups))
    if run_plan.groups and not by_stage:
        counts = [(len(run_plan.stages), "stage"), (len(run_plan.groups), "group")]
        text = " in ".join(f"{count} {plural(count, what)}" for count, what in counts)
        console.say(f"{text}; pano-mvs plan --stages lists each")
    for plan in run_plan.stages:
        by_reason = Counter(plan.run.values())
        for reason, count in by_reason.most_common(_SHOWN_REASONS):
            items = [item for item, why in plan.run.items() if why == reason and item]
            which = f":{items[0]}" + (f" and {count - 1} more" if count > 1 else "") if items else ""
            console.say(escape(f"{plan.name}{which}: {reason}"))
        if len(by_reason) > _SHOWN_REASONS:
            more = len(by_reason) - _SHOWN_REASONS
            console.print(f"{plan.name}: … and {more} other {plural(more, 'reason')}", highlight=False)
        for item, reason in list(plan.blocked.items())[:_SHOWN_REASONS]:
            console.say(escape(f"{plan.name}:{item}: cannot run: {reason}"))
    if dropped := sum(len(plan.dropped) for plan in run_plan.stages):
        whose = plural(dropped, "unit has a result that was", "units have results that were")
        console.say(f"{dropped} cached {whose} dropped after an earlier run; nothing reads it now")
    _print_total(run_plan, console)
    return run_plan


def _table(run_plan: RunPlan, groups: Mapping[str, Sequence[str]]) -> Table:
    """Return a table with a row for each group, and for each stage that is in none."""
    group_of = {stage: group for group, stages in groups.items() for stage in stages}
    rows: dict[str, list[tuple[StagePlan, StageForecast]]] = {}
    for plan, forecast in zip(run_plan.stages, run_plan.forecasts, strict=True):
        rows.setdefault(group_of.get(plan.name, f":{plan.name}"), []).append((plan, forecast))
    is_blocked = any(plan.blocked for plan in run_plan.stages)
    first = ("group", "stages to compute") if groups else ("stage", "use")
    table = Table(*first, "cached", "run", "may run", *(["cannot run"] if is_blocked else []), "time", "disk")
    for name, members in rows.items():
        is_group = not name.startswith(":")
        plans = [plan for plan, _ in members]
        counts = [str(sum(map(len, found)) or "") for found in ([p.cached for p in plans], [p.run for p in plans])]
        counts.append(_may_run(members))
        counts += [str(sum(len(plan.blocked) for plan in plans) or "")] if is_blocked else []
        pending = [plan.name for plan, forecast in members if forecast.units != 0 or plan.blocked]
        named = (plans[0].name, plans[0].use)
        if groups:
            named = (name if is_group else "", shortened_list(pending, 3) if is_group else plans[0].name)
        table.add_row(*named, *counts, *_expected([forecast for _, forecast in members], run_plan.workers))
    return table


def _may_run(members: Sequence[tuple[StagePlan, StageForecast]]) -> str:
    """Return the number of units that depend on others; of stages whose units are not known yet, the expected one."""
    count = sum(len(plan.may_run) for plan, _ in members if not plan.open)
    open_units = [forecast.units for plan, forecast in members if plan.open]
    if not open_units:
        return str(count or "")
    known = [units for units in open_units if units is not None]
    if len(known) == len(open_units):
        return f"about {count + sum(known)}"
    return f"at least {count + sum(known)}" if known or count else "all"


def _expected(forecasts: Sequence[StageForecast], workers: int) -> tuple[str, str]:
    """Return the expected time and disk space of stages as text; empty if they compute nothing."""
    own = [one for one in forecasts if one.units != 0]
    known = [one for one in own if one.seconds is not None]
    if not own:
        return "", ""
    if not known:
        return "unknown", "unknown"
    seconds = sum((one.seconds or 0.0) / max(1, min(workers, one.units or 1)) for one in known)
    at_least = "" if len(known) == len(own) else "at least "
    kept = [one for one in known if not one.is_temporary]
    if kept:
        size = f"{at_least}{size_text(round(sum(one.kept_bytes or 0.0 for one in kept)))}"
    else:  # a stage that is not known may keep its results
        size = "dropped" if all(one.is_temporary for one in own) else "unknown"
    return f"{at_least}{duration_text(seconds)}", size


def _print_total(run_plan: RunPlan, console: Console) -> None:
    """Print the number of units, and the expected time and disk space of all stages."""
    if not run_plan.units and not run_plan.may_follow:
        console.print("nothing to compute", highlight=False)
        return
    units = f"{run_plan.units} {plural(run_plan.units, 'unit')} would run"
    if run_plan.may_follow:
        count, known = run_plan.may_run
        units += f", and up to {count} more may" if known else ", and more may follow"
    console.print(units, highlight=False)
    unknown, workers = run_plan.unknown, f"{run_plan.workers} {plural(run_plan.workers, 'worker')}"
    if len(unknown) == sum(forecast.units != 0 for forecast in run_plan.forecasts):
        text = "time and disk space: unknown, because no earlier run with this cache computed these stages"
    else:
        bound = "at least" if unknown else "about"
        size = size_text(round(run_plan.stored_bytes))
        text = f"{bound} {duration_text(run_plan.seconds)} with {workers}, and {size} in the cache, by earlier runs"
        if dropped := round(run_plan.dropped_bytes):
            text += f"; up to {size_text(dropped)} more until it drops the results of temporary stages"
        text += f"; unknown: {shortened_list(unknown)}" if unknown else ""
        text += "; compiling kernels, which the first run does once, is not included" if must_compile() else ""
    console.say(escape(text))


def explain_unit(session: Session, label: str, console: Console) -> None:
    """Print the description of a unit, `STAGE:ITEM`, or `STAGE` if it has only one unit."""
    stage, _, item = label.partition(":")
    if group := session.workflow.groups.get(stage):
        raise UsageError(f"{stage} is a group of stages; give a unit of one of them: {', '.join(group.stages)}")
    workflow, graph = RunOptions(until=(stage,)).applied_to(session.workflow, session.graph)
    store = Store(session.store_root, for_reading=True)
    found: list[tuple[Unit, UnitRecord | None, str]] = []

    def look(unit: Unit, record: UnitRecord | None, reason: str) -> None:
        if (unit.entry.name, unit.item) == (stage, item):
            found.append((unit, record, reason))

    temporary = session.run_options.temporary_stages(session.workflow, session.graph)
    plan = make_plan(workflow, graph, store, visit=look, temporary=temporary)[-1]
    if not found:
        console.say(escape(f"{label}: {_why_not(plan, item)}"))
        return
    for line in _lines(*found[0], store=store):
        console.say(escape(line))


def _why_not(plan: StagePlan, item: str) -> str:
    if item in plan.blocked:
        return f"cannot run: {plan.blocked[item]}"
    if item in plan.may_run or plan.open:
        return "waits for outputs that are not computed yet; run what it needs first"
    known = [*plan.cached, *plan.run]
    shown = shortened_list(known, 8, rest=" …")
    raise UsageError(f"{plan.name} has no unit {item!r}; it has: {shown or 'none'}")


def _lines(unit: Unit, record: UnitRecord | None, reason: str, *, store: Store) -> list[str]:
    spec = unit.entry.spec
    lines = [
        f"{unit.label}: {'cached' if record is not None else f'would run: {reason}'}",
        f"stage    {spec.name} version {spec.version}, {spec.origin}",
        f"key      {unit.key}",
        f"code     {unit.identity['code']}",
    ]
    lines += [f"library  {name} {version}" for name, version in sorted(unit.identity["libraries"].items())]
    lines += [f"setting  {name}: {value!r}" for name, value in sorted(unit.identity["params"].items())]
    lines += [f"file     {role}: {path}" for role, path in (unit.source.files.items() if unit.source else ())]
    lines += [f"reads    {port}: {_read(value)}" for port, value in unit.inputs.items()]
    if record is None:
        return lines
    lines.append(f"took     {record.seconds:.2f} s")
    lines += [f"figure   {name}: {value:z.6g}" for name, value in record.metrics.items()]
    lines += [f"note     {note}" for note in record.notes]
    for name, ref in record.output.parts.items():
        place = store.blobs.place(ref)
        where = place if isinstance(place, Path) else place.name
        if record.dropped and not store.blobs.exists(ref):
            where = "dropped after an earlier run; computed again when something reads it"
        lines.append(f"result   {record.output.kind}.{name}: {where} ({ref.size_bytes} bytes)")
    return lines


def _read(value: UnitInput) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, ItemRef):
        return f"{value.kind} {value.digest}"
    names = [f"{name} ({ref.digest[:8]})" if ref.digest else name for name, ref in value.items()]
    return shortened_list(names, 8, rest=" and {more} more")


def show_status(
    target: str,
    out: Path | None,
    *,
    overrides: Sequence[str],
    images: Path | None,
    cache: Path | None,
    console: Console,
) -> None:
    """Print the outcome of the latest run into an output folder, then what its workflow would compute now.

    Of a folder of merged blocks, the outcome of the merge and of each block is printed instead.

    Args:
        target: a workflow, or an output folder, whose run.json states workflow, settings, images and cache.
    """
    if is_folder(Path(target)):
        latest = _print_latest(Path(target), console)
        if latest is not None and latest.merged is not None:
            for block in latest.merged.blocks:
                console.say(escape(f"block {block}:"))
                _print_latest(Path(block), console)
            return
    session = reopen(target, overrides=overrides, images=images, cache=cache)
    session = session if out is None else replace(session, out=out)
    if not is_folder(Path(target)):
        _print_latest(session.out, console)
    run_plan = show_plan(session, console)
    if run_plan.units:
        console.print("to compute this:", highlight=False)
        console.say(f"  {escape(run_command(session))}")


def _print_latest(out: Path, console: Console) -> RunSummary | None:
    """Print how the latest run into a folder ended, and return what its run.json holds; None if it cannot be read."""
    if not is_file(out / RUN_JSON):
        console.print(f"no finished run in {escape(str(out))}", highlight=False)
        return None
    try:
        latest = RunSummary.read(out)
    except InputError as error:
        console.say(escape(str(error)))
        return None
    if latest.merged is not None:
        text = f"merged {latest.started} from {len(latest.merged.blocks)} blocks: exit code {latest.exit_code}"
    else:
        units = latest.units
        counts = f"{units.run} computed, {units.cached} cached, {units.failed} failed"
        text = f"latest run {latest.started}: exit code {latest.exit_code}, {counts}"
    console.print(text, highlight=False)
    for failure in latest.failures:
        console.say(escape(f"  {failure.label}: {failure.cause}"))
    if latest.stopped:
        console.say(escape(f"  stopped: {latest.stopped}"))
    if latest.verdict is not None:
        print_verdict(latest.verdict, console)
    return latest


def show_workflow(session: Session, out: Path | None, *, resolved: bool, text: bool) -> None:
    """Print the groups of a workflow, or write its YAML.

    Args:
        out: file to write; None to print.
        resolved: whether to write one file with all settings.
        text: whether to write its files as they are; so is what is written to `out`.
    """
    if not resolved and not text and out is None:
        _show_groups(session.workflow, Console())
        return
    _write_text(resolved_yaml(session.workflow, session.graph) if resolved else session.workflow.text, out)


def _show_groups(workflow: Workflow, console: Console) -> None:
    """Print each group of a workflow with what it does and its stages, and the stages that are in none."""
    table = Table("group", "what it does", "stages")
    shown: set[str] = set()
    for entry in workflow.stages.values():
        group = workflow.groups.get(entry.group)
        if group is None:
            table.add_row("", escape(entry.spec.doc.partition("\n")[0]), escape(entry.name))
        elif entry.group not in shown:
            shown.add(entry.group)
            table.add_row(escape(entry.group), escape(group.description), escape(", ".join(group.stages)))
    console.show(table)
    count = len(workflow.stages)
    console.say(
        f"{count} {plural(count, 'stage')}; --resolved prints them with all settings, --text the files as they are"
    )


def _write_text(text: str, out: Path | None) -> None:
    text = without_controls(text).rstrip("\n")
    if out is None:
        print(text)
        return
    if exists(out):
        raise UsageError(f"--out {out}: there is such a file already. Give a new name, or remove the file")
    write_given(out, f"{text}\n", f"--out {out}")
    print(f"written to {out}")


def show_schema(workflow: str | None, out: Path | None) -> None:
    """Write the schema of workflows to a file or to the standard output."""
    registry = Registry.installed()
    inherited, groups = ({}, frozenset[str]()) if workflow is None else _inherited(workflow, registry)
    text = json.dumps(workflow_schema(registry, inherited, groups), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    write_given(out, text, f"--out {out}")
    hint = f"put this line at the top of a workflow: # yaml-language-server: $schema={out.as_posix()}"
    Console().say(escape(hint))


def _inherited(workflow: str, registry: Registry) -> tuple[dict[str, Located], frozenset[str]]:
    path, _ = find_workflow(workflow, presets_folder())
    reader = WorkflowReader(str(path), path.parent, registry, presets=presets_folder())
    return reader.inherited(read_text(path), path)
