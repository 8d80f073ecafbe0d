"""Show what a run would do, and what the latest one did."""

from __future__ import annotations

import gc
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.session import Session
from pano_mvs.core.errors import StoreError
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.running.run import workflow_id

_SHOWN_REASONS = 5


def show_plan(session: Session, console: Console) -> None:
    """Print per stage how many units are cached, would run, or may run, and why."""
    plans = _plans(session)
    table = Table("stage", "use", "cached", "run", "may run", "cannot run")
    for plan in plans:
        waiting = "all (units not known yet)" if plan.open else str(len(plan.may_run) or "")
        table.add_row(plan.name, plan.use, str(len(plan.cached) or ""), str(len(plan.run) or ""), waiting,
                      str(len(plan.blocked) or ""))  # fmt: skip
    console.print(table)
    for plan in plans:
        _print_reasons(plan, console)
    total = sum(len(plan.run) for plan in plans)
    may = sum(len(plan.may_run) for plan in plans) + sum(plan.open for plan in plans)
    text = "nothing to compute" if not total and not may else f"{total} {plural(total, 'unit')} would run"
    console.print(text + (", more may follow" if may else ""), highlight=False)


def show_status(session: Session, console: Console) -> None:
    """Print what the latest run into the output folder said, then what is cached now."""
    path = session.out / "run.json"
    try:
        last = json.loads(path.read_bytes())
    except OSError:
        console.print(f"no finished run in {escape(str(session.out))}", highlight=False)
    except ValueError:
        console.print(f"{escape(str(path))} is damaged; run again to write it anew", highlight=False)
    else:
        try:
            _print_last(last, console)
        except (KeyError, TypeError):
            console.print(f"{escape(str(path))} is not of this version; run again to write it anew", highlight=False)
    show_plan(session, console)


def _print_last(last: Any, console: Console) -> None:
    units = last["units"]
    console.print(f"latest run {last['started']}: exit code {last['exit_code']}, {units['run']} computed, "
                  f"{units['cached']} cached, {units['failed']} failed", highlight=False)  # fmt: skip
    for failure in last["failures"]:
        console.print(escape(f"  {failure['stage']}:{failure['item']}: {failure['cause']}"), highlight=False)


@contextmanager
def without_collector() -> Iterator[None]:
    """Hold back Python's search for cycles: a plan builds a million objects that all stay, and has none."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _plans(session: Session) -> list[StagePlan]:
    store = Store(session.store_root, for_reading=True)
    workflow, graph = session.demands.applied_to(session.workflow, session.graph)
    with without_collector():
        plans = make_plan(workflow, graph, store, workflow_id(session.workflow), session.demands)
    with suppress(StoreError):  # a cache that others own may be read all the same
        store.stat_cache.save()
    return plans


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
