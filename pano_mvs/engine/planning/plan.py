"""Plan a run: which units are cached, which are computed and why, and which are decided later."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.reasons import reason_to_run
from pano_mvs.engine.planning.resolve import resolve
from pano_mvs.engine.planning.run_options import DEFAULT_OPTIONS, RunOptions
from pano_mvs.engine.planning.source_listing import SourceListing
from pano_mvs.engine.planning.units import StageState, Unit
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow


@dataclass(slots=True)
class StagePlan:
    """What a run would do in one stage.

    Attributes:
        name: of the stage in the workflow.
        use: of the stage in the registry.
        cached: units that are in the cache.
        run: unit that would be computed, to the reason.
        may_run: units that depend on units that would be computed; they run if these give other results.
        blocked: unit to the reason why it cannot run.
        open: whether the number of units is not known yet.
    """

    name: str
    use: str
    cached: list[str] = field(default_factory=list)
    run: dict[str, str] = field(default_factory=dict)
    may_run: list[str] = field(default_factory=list)
    blocked: dict[str, str] = field(default_factory=dict)
    open: bool = False


def make_plan(
    workflow: Workflow,
    graph: Graph,
    store: Store,
    *,
    options: RunOptions = DEFAULT_OPTIONS,
    listing: SourceListing | None = None,
    visit: Callable[[Unit, UnitRecord | None, str], None] | None = None,
) -> list[StagePlan]:
    """Return what a run would do, stage by stage, without running anything.

    Args:
        workflow: with the options applied.
        graph: likewise.
        store: the cache.
        options: of the run.
        listing: what the run has listed so far; None to list the items of the sources again.
        visit: called for each unit whose inputs are known, with its record or None, and the reason to compute it.

    Raises:
        InputError: if the source cannot be listed.
    """
    last = store.runs.last_keys(workflow.id)
    states: dict[str, StageState] = {}
    plans: list[StagePlan] = []
    for name in graph.order:
        entry = workflow.stages[name]
        state, plan = StageState(graph.axes[name]), StagePlan(name, entry.spec.name)
        units, resolution = resolve(entry, graph, states=states, store=store, listing=listing)
        for unit in units:
            record = None
            if not options.refreshes(unit):
                last_key = last.get(name, {}).get(unit.item)
                record = store.find(unit.key) or options.acceptable(unit, last_key, store)
            if record is not None:
                settle(state, unit, record)
                plan.cached.append(unit.item)
            else:
                state.pending.add(unit.item)
                plan.run[unit.item] = _reason(unit, last.get(name, {}), store, is_asked=options.refreshes(unit))
            if visit is not None:
                visit(unit, record, plan.run.get(unit.item, ""))
        state.members, state.failed = resolution.members, resolution.blocked
        state.pending.update(resolution.waiting)
        state.open = resolution.open
        plan.may_run, plan.blocked, plan.open = resolution.waiting, resolution.blocked, resolution.open
        states[name] = state
        plans.append(plan)
    return plans


def settle(state: StageState, unit: Unit, record: UnitRecord) -> None:
    """Enter a unit's result into the state of its stage."""
    state.items[unit.item] = record.output
    state.exploded.update(record.items)


def _reason(unit: Unit, last: Mapping[str, str], store: Store, *, is_asked: bool) -> str:
    if is_asked:
        return "--refresh"
    return reason_to_run(unit, last.get(unit.item), store)
