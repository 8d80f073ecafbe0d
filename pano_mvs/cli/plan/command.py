"""Show what a run would compute, and what the latest one did."""

from __future__ import annotations

from collections import Counter

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import plural
from pano_mvs.engine.planning.plan import StagePlan
from pano_mvs.results.summary import RUN_JSON, RunSummary
from pano_mvs.session.planning import plan_session
from pano_mvs.session.session import Session

_SHOWN_REASONS = 5


def show_plan(session: Session, console: Console) -> None:
    """Print the number of cached units per stage, and the units that would or may run, with reasons."""
    run_plan = plan_session(session)
    plans = run_plan.stages
    table = Table("stage", "use", "cached", "run", "may run", "cannot run")
    for plan in plans:
        waiting = "all (units not known yet)" if plan.open else str(len(plan.may_run) or "")
        table.add_row(
            plan.name,
            plan.use,
            str(len(plan.cached) or ""),
            str(len(plan.run) or ""),
            waiting,
            str(len(plan.blocked) or ""),
        )
    console.print(table)
    for plan in plans:
        _print_reasons(plan, console)
    nothing = not run_plan.units and not run_plan.may_follow
    text = "nothing to compute" if nothing else f"{run_plan.units} {plural(run_plan.units, 'unit')} would run"
    console.print(text + (", more may follow" if run_plan.may_follow else ""), highlight=False)


def show_status(session: Session, console: Console) -> None:
    """Print the outcome of the latest run into the output folder, then the state of the cache."""
    if not is_file(session.out / RUN_JSON):
        console.print(f"no finished run in {escape(str(session.out))}", highlight=False)
    else:
        try:
            _print_last(RunSummary.read(session.out), console)
        except InputError as error:
            console.print(escape(str(error)), highlight=False, soft_wrap=True)
    show_plan(session, console)


def _print_last(last: RunSummary, console: Console) -> None:
    units = last.units
    text = f"exit code {last.exit_code}, {units.run} computed, {units.cached} cached, {units.failed} failed"
    console.print(f"latest run {last.started}: {text}", highlight=False)
    for failure in last.failures:
        console.print(escape(f"  {failure.stage}:{failure.item}: {failure.cause}"), highlight=False)


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
