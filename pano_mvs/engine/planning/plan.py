"""What a run would do: per unit cached, run (and why), or may run because it waits for an output."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.reasons import reason_to_run
from pano_mvs.engine.planning.resolve import resolve
from pano_mvs.engine.planning.run_options import DEFAULT_OPTIONS, RunOptions
from pano_mvs.engine.planning.units import StageState, Unit
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow


@dataclass(slots=True)
class StagePlan:
    """What a run would do in one stage.

    Attributes:
        name: of the stage in the workflow.
        use: of the stage in the registry.
        cached: units that would not run.
        run: unit to the reason why it would.
        may_run: units that wait for an output, which may turn out the same.
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
    workflow_id: str,
    options: RunOptions = DEFAULT_OPTIONS,
    *,
    visit: Callable[[Unit, UnitRecord | None, str], None] | None = None,
) -> list[StagePlan]:
    """Return what a run would do, stage by stage, without running anything.

    Args:
        workflow: as the run would see it, likewise its graph.
        graph: wired.
        store: where finished units are.
        workflow_id: under which the latest run is remembered.
        options: what is asked of the run.
        visit: called for each unit whose inputs are known, with its record if it has one, else the reason to run.

    Raises:
        InputError: if the source cannot be listed.
    """
    last = store.runs.last_keys(workflow_id)
    states: dict[str, StageState] = {}
    plans: list[StagePlan] = []
    for name in graph.order:
        entry = workflow.stages[name]
        state, plan = StageState(graph.axes[name]), StagePlan(name, entry.spec.name)
        units, resolution = resolve(entry, graph, states, store)
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
                plan.run[unit.item] = _reason(unit, last.get(name, {}), store, options)
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
    """Enter a unit's stored value into its stage's state."""
    state.items[unit.item] = record.output
    state.exploded.update(record.items)


def _reason(unit: Unit, last: Mapping[str, str], store: Store, options: RunOptions) -> str:
    if options.refreshes(unit):
        return "asked for"
    return reason_to_run(unit, last.get(unit.item), store)
