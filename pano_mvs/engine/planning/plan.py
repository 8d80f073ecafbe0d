"""Plan a run by its options: which units are cached, which are computed and why, and which are decided later."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import shortened_list
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.planning.temporary import items_read, temporary_stages
from pano_mvs.engine.planning.unit_keys import SourceListing, resolve
from pano_mvs.engine.planning.units import OF_CODE, WHOLE, StageState, Unit
from pano_mvs.engine.stages.stage import Cardinality
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The options of one run."""

    until: tuple[str, ...] = ()  # the run ends after these stages and groups of stages; empty to run all
    # units, as `STAGE:ITEM`; the run is limited to them and what they need. Empty to run all.
    only: tuple[str, ...] = ()
    # stages, groups and units, as `STAGE`, `GROUP` or `STAGE:ITEM`, that are computed again although they are cached
    refresh: tuple[str, ...] = ()
    # reuse results that differ from what is needed only in the code or the libraries that computed them
    accept_code: bool = False
    keep_going: bool = False  # go on after a failed unit even if its stage says `on_error: stop`
    isolate: bool = False  # compute each unit of a plugin's stage in a process of its own
    keep_all: bool = False  # drop no results, as if no stage were temporary

    @property
    def is_partial(self) -> bool:
        """Whether the run is limited to some stages or units."""
        return bool(self.until or self.only)

    def applied_to(self, workflow: Workflow, graph: Graph) -> tuple[Workflow, Graph]:
        """Return the workflow and the graph with the options applied.

        Raises:
            UsageError: if an option names a stage or a group that the workflow does not have.
        """
        for name in (*self.until, *self.refresh, *map(_stage, self.only)):
            if _stage(name) not in graph.edges and (name not in workflow.groups or name not in self._with_groups):
                raise UsageError(_unknown_stage(_stage(name), workflow, graph))
        if self.keep_going:
            stages = {
                name: dataclasses.replace(entry, policy=entry.policy.model_copy(update={"on_error": "skip"}))
                for name, entry in workflow.stages.items()
            }
            workflow = dataclasses.replace(workflow, stages=stages)
        until = {stage for name in self.until for stage in stages_named(name, workflow)}
        ends = until | set(map(_stage, self.only))
        return workflow, graph.limited_to(ends, _items_by_stage(self.only)) if ends else graph

    def temporary_stages(self, workflow: Workflow, graph: Graph) -> dict[str, frozenset[str]]:
        """Return each stage whose results the run may drop with the stages that read it; see `temporary_stages`.

        Args:
            workflow: and the graph, as `applied_to` returns them.
        """
        if self.keep_all:
            return {}
        until = {stage for name in self.until for stage in stages_named(name, workflow)}
        return temporary_stages(workflow, graph, wanted=until | set(map(_stage, self.only)))

    def refreshes(self, unit: Unit) -> bool:
        """Return whether a unit is computed again even if it is cached."""
        entry = unit.entry
        names = (entry.name, f"{entry.name}:{unit.item}", *([entry.group] if entry.group else []))
        return any(name in self.refresh for name in names)

    @property
    def _with_groups(self) -> tuple[str, ...]:
        """What may name a group."""
        return (*self.until, *self.refresh)

    def accepted(
        self, unit: Unit, last_key: str | None, store: Store, *, or_dropped: bool = False
    ) -> UnitRecord | None:
        """Return what `acceptable` returns, and store it under the new key, so that the next run finds it."""
        record = self.acceptable(unit, last_key, store, or_dropped=or_dropped)
        if record is not None:
            store.put(record)
        return record

    def acceptable(
        self, unit: Unit, last_key: str | None, store: Store, *, or_dropped: bool = False
    ) -> UnitRecord | None:
        """Return the record of the last run for a unit if only code or libraries changed and `accept_code` is set.

        Args:
            or_dropped: whether the result may have been dropped; see `Store.find`.
        """
        last = store.find(last_key, or_dropped=or_dropped) if self.accept_code and last_key else None
        if last is None or not only_the_code_differs(last.identity, unit.identity):
            return None
        return dataclasses.replace(last, key=unit.key, identity=unit.identity)


DEFAULT_OPTIONS = RunOptions()


def stages_named(name: str, workflow: Workflow) -> tuple[str, ...]:
    """Return the stages that a name stands for: those of a group, or the stage of this name."""
    group = workflow.groups.get(name)
    return (name,) if group is None else group.stages


def _stage(unit: str) -> str:
    return unit.partition(":")[0]


def _unknown_stage(name: str, workflow: Workflow, graph: Graph) -> str:
    if name in workflow.groups:
        return f"{name!r} is a group of stages; give one of its stages: {', '.join(workflow.groups[name].stages)}"
    groups = f"; groups: {', '.join(workflow.groups)}" if workflow.groups else ""
    return f"there is no stage {name!r} in this workflow; it has: {', '.join(graph.order)}{groups}"


def _items_by_stage(units: Iterable[str]) -> Mapping[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for unit in units:
        stage, _, item = unit.partition(":")
        found.setdefault(stage, set()).add(item)
    return {stage: frozenset(items) for stage, items in found.items() if "" not in items}


def reason_to_run(unit: Unit, last_key: str | None, store: Store) -> str:
    """Return why a unit is not in the cache.

    Args:
        last_key: its key in the latest run of this workflow; None if it was not part of that run.
        store: the cache, which may still have the record of that run.
    """
    if last_key is None:
        return "new"
    last = store.read_record(last_key)
    if last_key == unit.key:
        if last is not None and last.dropped:
            return "dropped after an earlier run, and to be kept now"
        return "its cached result is missing or damaged, or it did not finish"
    if last is None:
        return "changed (the record of the last run is missing)"
    before, now = last.identity, unit.identity
    if before.get("schema") != now["schema"]:
        return "this version makes its key differently"
    differences = [
        *_differences("param", before.get("params", {}), now["params"]),
        *_inputs(unit, before.get("inputs", {}), now["inputs"]),
    ]
    if before.get("stage") != now["stage"]:
        differences.insert(0, f"stage {before.get('stage')} → {now['stage']}")
    elif before.get("version") != now["version"]:
        differences.insert(0, f"version of {now['stage']} {before.get('version')} → {now['version']}")
    if before.get("code") != now["code"]:
        file = f" ({unit.entry.spec.origin.rpartition(':')[0]})" if unit.entry.spec.code_digest else ""
        differences.insert(0, f"code of {now['stage']} changed{file}")
    libraries = before.get("libraries")
    if isinstance(libraries, Mapping):
        both = sorted({*libraries} & {*now["libraries"]})
        pairs = [(name, libraries[name], now["libraries"][name]) for name in both]
        differences.extend(f"{name} {old} → {new}" for name, old, new in pairs if old != new)
    if before.get("rng_seed", 0) != now.get("rng_seed", 0):
        differences.append(f"rng_seed {before.get('rng_seed', 0)} → {now.get('rng_seed', 0)}")
    differences.extend(_differences("kind", before.get("kinds", {}), now["kinds"]))
    return "; ".join(differences) or "this version makes its key differently"


def only_the_code_differs(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Return whether two identities differ, and only in the code or the libraries."""
    parts = {*before, *now} - OF_CODE
    return before != now and all(name in before and name in now and before[name] == now[name] for name in parts)


def _differences(what: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"{what} {name} {before.get(name)!r} → {now.get(name)!r}"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]


def _inputs(unit: Unit, before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    changed: list[str] = []
    if unit.source is not None and before.get("name") != now["name"]:
        return [f"renamed from {before.get('name')}"]
    for port in sorted({*before, *now}):
        old, new = before.get(port), now.get(port)
        if old == new:
            continue
        if unit.source is not None:
            changed.extend(f"input {path.name}" for path in unit.source.files.values())
        else:
            changed.append(f"input {port}: {_changed_items(unit, port, old=old, new=new)}")
    return changed


def _changed_items(unit: Unit, port: str, *, old: Any, new: Any) -> str:
    value = unit.inputs.get(port)
    if value is None or isinstance(value, ItemRef):
        return unit.item or "changed"
    known = {str(entry) for entry in old or []}
    names = [name for name, entry in zip(value, new, strict=True) if str(entry) not in known]
    if not names:
        return "fewer items" if len(new) < len(old or []) else "another order"
    return shortened_list(names, rest=" and {more} more")


@dataclass(slots=True)
class StagePlan:
    """What a run would do in one stage."""

    name: str
    use: str
    cached: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)  # those of `cached` whose results were dropped and nothing reads
    run: dict[str, str] = field(default_factory=dict)  # unit that would be computed, to the reason
    # units that depend on units that would be computed; they run if these give other results
    may_run: list[str] = field(default_factory=list)
    blocked: dict[str, str] = field(default_factory=dict)  # unit to the reason why it cannot run
    open: bool = False  # whether the number of units is not known yet


def make_plan(
    workflow: Workflow,
    graph: Graph,
    store: Store,
    *,
    options: RunOptions = DEFAULT_OPTIONS,
    listing: SourceListing | None = None,
    visit: Callable[[Unit, UnitRecord | None, str], None] | None = None,
    failed: Collection[tuple[str, str]] = (),
    temporary: Collection[str] | None = None,
) -> list[StagePlan]:
    """Return what a run would do, stage by stage, without running anything.

    Args:
        listing: what the run has listed so far; None to list the items of the sources again.
        visit: called for each unit whose inputs are known, with its record or None, and the reason to compute it.
        failed: stages and units that have no result; by default, all units are expected to have one.
        temporary: stages whose results may have been dropped; None for those of the options.

    Raises:
        InputError: if the source cannot be listed.
    """
    last = store.runs.last_keys(workflow.id)
    temporary = options.temporary_stages(workflow, graph) if temporary is None else temporary
    drops = _DroppedUnits(graph, store)
    states: dict[str, StageState] = {}
    plans: list[StagePlan] = []
    for name in graph.order:
        entry = workflow.stages[name]
        states[name] = state = StageState(graph.axes[name])
        plan = StagePlan(name, entry.spec.name)
        for unit in resolve(entry, graph, states=states, store=store, listing=listing):
            last_key, is_asked = last.get(name, {}).get(unit.item), options.refreshes(unit)
            record = None
            if not is_asked:
                may_drop = name in temporary
                record = store.find(unit.key, or_dropped=may_drop)
                record = record or options.acceptable(unit, last_key, store, or_dropped=may_drop)
            if record is not None:
                settle(state, unit, record)
                plan.cached.append(unit.item)
            elif (name, unit.item) in failed:
                state.failed[unit.item] = "failed in the latest run"
            else:
                state.pending.add(unit.item)
                plan.run[unit.item] = "--refresh" if is_asked else reason_to_run(unit, last_key, store)
            drops.look(unit, record, state)
            if visit is not None:
                visit(unit, record, plan.run.get(unit.item, ""))
        plan.may_run = [item for item in state.members if item in state.pending and item not in plan.run]
        plan.blocked, plan.open = state.failed, state.open
        plans.append(plan)
    drops.enter_into(plans, states)
    return plans


class _DroppedUnits:
    """The units of a plan whose results were dropped, and those of them that are computed again."""

    def __init__(self, graph: Graph, store: Store) -> None:
        self._graph = graph
        self._store = store
        self._dropped: dict[str, dict[str, None]] = {}  # stage to its dropped units, in order
        self._makers: dict[str, dict[str, str]] = {}  # stage to image to the dropped unit of whose collection it is
        self._reads: dict[tuple[str, str], list[tuple[str, str]]] = {}  # unit to the dropped units that it reads

    def look(self, unit: Unit, record: UnitRecord | None, state: StageState) -> None:
        """Take a unit of the plan into account, after those that it reads."""
        name = unit.entry.name
        is_dropped = record is not None and record.dropped and not all(map(self._store.blobs.exists, record.blobs()))
        if record is not None and is_dropped:
            self._dropped.setdefault(name, {})[unit.item] = None
            self._makers.setdefault(name, {}).update(dict.fromkeys(record.items, unit.item))
        if self._dropped and (is_dropped or unit.item in state.pending):
            self._reads[name, unit.item] = list(self._dropped_inputs(unit))

    def enter_into(self, plans: Sequence[StagePlan], states: Mapping[str, StageState]) -> None:
        """Move the units that are computed again from `cached` to `run`, or to `may_run` if that is not certain."""
        if not self._dropped:
            return
        found = {plan.name: plan for plan in plans}
        again = self._followed((plan.name, item) for plan in plans for item in plan.run)
        for (name, item), reader in again.items():
            found[name].run[item] = f"dropped after an earlier run; {reader} reads it"
        waiting = [plan for plan in plans if plan.open or plan.may_run]
        may_follow = dict.fromkeys(
            unit for plan in waiting for unit in self._inputs_of_waiting(plan, states[plan.name])
        )
        maybe = [unit for unit in (*may_follow, *self._followed(may_follow)) if unit not in again]
        for name, item in dict.fromkeys(maybe):
            found[name].may_run.append(item)
        moved = {*again, *maybe}
        for plan in plans:
            in_order = dict.fromkeys((*self._dropped.get(plan.name, ()), *plan.run))
            plan.run = {item: plan.run[item] for item in in_order if item in plan.run}
            plan.cached = [item for item in plan.cached if (plan.name, item) not in moved]
            plan.dropped = [item for item in self._dropped.get(plan.name, ()) if (plan.name, item) not in moved]

    def _dropped_inputs(self, unit: Unit) -> Iterator[tuple[str, str]]:
        for edge, name, _ in items_read(unit, self._graph.edges[unit.entry.name]):
            makers = self._makers.get(edge.producer, {})
            item = makers.get(name, WHOLE) if edge.exploded else name
            if item in self._dropped.get(edge.producer, {}):
                yield edge.producer, item

    def _followed(self, units: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
        """Return the dropped units that some units read, directly or through others, to a stage that reads each."""
        found: dict[tuple[str, str], str] = {}
        pending = deque(units)
        while pending:
            reader = pending.popleft()
            for unit in self._reads.get(reader, ()):
                if unit not in found:
                    found[unit] = reader[0]
                    pending.append(unit)
        return found

    def _inputs_of_waiting(self, plan: StagePlan, state: StageState) -> Iterator[tuple[str, str]]:
        """Yield the dropped units that the units of a stage may read that wait for others."""
        for edge in self._graph.edges[plan.name].values():
            dropped = self._dropped.get(edge.producer, {})
            read: Iterable[str] = dropped
            if not plan.open and not edge.exploded:
                match edge.port.cardinality:
                    case Cardinality.EACH:
                        read = plan.may_run
                    case Cardinality.NEAR:
                        read = (near for item in plan.may_run for near in state.near.get(item, ()))
            yield from ((edge.producer, item) for item in read if item in dropped)


def settle(state: StageState, unit: Unit, record: UnitRecord) -> None:
    """Enter a unit's result into the state of its stage."""
    state.items[unit.item] = record.output
    state.exploded.update(record.items)
