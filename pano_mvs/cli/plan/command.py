"""Show what a run would compute, and what that is expected to take."""

from __future__ import annotations

from collections import Counter

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.cache.command import size_text
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import duration_text, plural, shortened_list
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.planning.plan import StagePlan
from pano_mvs.session.planning import RunPlan, plan_session
from pano_mvs.session.running import Execution
from pano_mvs.session.session import Session, check_output

_SHOWN_REASONS = 5


def show_dry_run(session: Session, execution: Execution, console: Console, *, as_json: bool) -> None:
    """Print the plan of a run, for its number of workers.

    Raises:
        UsageError: if the output folder cannot be used, or JSON is requested.
    """
    if as_json:
        raise UsageError("--dry-run prints a table, not events: leave out --json")
    check_output(session)
    workers = 1 if execution.executor == "serial" else execution.workers
    show_plan(session, console, workers=workers, threads=execution.threads)


def show_plan(session: Session, console: Console, *, workers: int = 0, threads: int = 0) -> RunPlan:
    """Print for each stage the units that are cached and that would or may run, with reasons, times and sizes.

    Args:
        session: the session.
        console: where to print.
        workers: number of units at a time, for the times; 0 for the default.
        threads: of each worker; 0 for the default.
    """
    run_plan = plan_session(session, workers=workers, threads=threads)
    is_blocked = any(plan.blocked for plan in run_plan.stages)
    table = Table("stage", "use", "cached", "run", "may run", *(["cannot run"] if is_blocked else []), "time", "disk")
    for plan, forecast in zip(run_plan.stages, run_plan.forecasts, strict=True):
        counts = [str(len(plan.cached) or ""), str(len(plan.run) or ""), _may_run(plan, forecast)]
        counts += [str(len(plan.blocked) or "")] if is_blocked else []
        table.add_row(plan.name, plan.use, *counts, *_expected(forecast, run_plan.workers))
    console.print(table)
    for plan in run_plan.stages:
        _print_reasons(plan, console)
    _print_total(run_plan, console)
    return run_plan


def _may_run(plan: StagePlan, forecast: StageForecast) -> str:
    """Return the number of units that depend on others; of a stage whose units are not known yet, the expected one."""
    if not plan.open:
        return str(len(plan.may_run) or "")
    return "all" if forecast.units is None else f"about {forecast.units}"


def _expected(forecast: StageForecast, workers: int) -> tuple[str, str]:
    """Return the expected time and disk space of a stage as text; empty if it computes nothing."""
    if forecast.units == 0:
        return "", ""
    if forecast.seconds is None or forecast.stored_bytes is None:
        return "unknown", "unknown"
    at_a_time = max(1, min(workers, forecast.units or 1))
    return duration_text(forecast.seconds / at_a_time), size_text(round(forecast.stored_bytes))


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
        text += f"; unknown: {shortened_list(unknown)}" if unknown else ""
    console.print(escape(text), highlight=False, soft_wrap=True)


def _print_reasons(plan: StagePlan, console: Console) -> None:
    by_reason = Counter(plan.run.values())
    for reason, count in by_reason.most_common(_SHOWN_REASONS):
        items = [item for item, why in plan.run.items() if why == reason and item]
        which = f":{items[0]}" + (f" and {count - 1} more" if count > 1 else "") if items else ""
        console.print(escape(f"{plan.name}{which}: {reason}"), highlight=False, soft_wrap=True)
    if len(by_reason) > _SHOWN_REASONS:
        more = len(by_reason) - _SHOWN_REASONS
        console.print(f"{plan.name}: … and {more} other {plural(more, 'reason')}", highlight=False)
    for item, reason in list(plan.blocked.items())[:_SHOWN_REASONS]:
        console.print(escape(f"{plan.name}:{item}: cannot run: {reason}"), highlight=False, soft_wrap=True)
