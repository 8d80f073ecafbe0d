"""The units of work that can run now: each becomes ready as soon as its own inputs exist.

A unit waits for tokens. A token stands for one settled unit of a producing stage (it has a result, or cannot have one)
or for a whole stage that is complete. The list of a stage's units waits for the lists of the stages that feed it. Every
order in this module follows the workflow and the capture, never the time at which something happened.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.planning.unit_keys import Resolver, SourceListing, resolve_source
from pano_mvs.engine.planning.units import WHOLE, StageState, Unit
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality
from pano_mvs.engine.workflows.wiring import Edge, Graph
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow

Token: TypeAlias = "tuple[str, str | None]"  # noqa: S105 (no password)
"""Stage and unit, for a unit that is settled; stage and None, for a stage that is complete."""


class Listener(Protocol):
    """Is notified of the progress of the stages."""

    def source_listed(self, entry: StageEntry, notes: Mapping[str, tuple[str, ...]]) -> None:
        """The images of a source are known, with the notes on each."""

    def stage_opened(self, entry: StageEntry) -> None:
        """The units of a stage are known."""

    def unit_blocked(self, entry: StageEntry, item: str, reason: str) -> None:
        """A unit cannot run."""

    def stage_complete(self, entry: StageEntry) -> None:
        """All units of a stage are settled; an error raised here stops what waits for the stage."""


@dataclass(slots=True)
class _Stage:
    entry: StageEntry
    position: int
    edges: Mapping[str, Edge]
    resolver: Resolver
    rank: dict[str, int] = field(default_factory=dict)  # unit to its position in the capture, while the stage is open
    missing: dict[str, int] = field(default_factory=dict)  # unit to the number of tokens it still waits for
    found: dict[str, Unit] = field(default_factory=dict)  # a source's units
    collections: dict[str, Mapping[str, ItemRef]] = field(default_factory=dict)
    unsettled: int = 0


class ReadyQueue:
    """The state of all stages during a pass, and the units that can run."""

    def __init__(
        self,
        workflow: Workflow,
        graph: Graph,
        store: Store,
        *,
        listener: Listener,
        listing: SourceListing | None = None,
    ) -> None:
        self.listing = listing or SourceListing()
        # stage to its results so far, in the order of the workflow
        self.states = {name: StageState(graph.axes[name], open=True) for name in graph.order}
        self._store = store
        self._only = graph.only
        self._listener = listener
        self._stages = {
            name: _Stage(
                (entry := workflow.stages[name]),
                position,
                graph.edges[name],
                Resolver(entry, graph, states=self.states, store=store),
            )
            for position, name in enumerate(graph.order)
        }
        self._ready: list[tuple[int, int, str, str]] = []
        self._waiting: dict[Token, list[tuple[str, str]]] = {}
        self._complete: set[str] = set()
        self._work: deque[Token] = deque()

    def start(self) -> None:
        """List the units of the stages that wait for nothing, and of those behind them as far as possible."""
        for name in self.states:
            if self.states[name].open:
                self._open_if_known(name)
        self._spread()

    def next_unit(self) -> Unit | None:
        """Return the first unit, in the order of the workflow, that can run; None if all wait or are settled."""
        while self._ready:
            _, _, name, item = heapq.heappop(self._ready)
            stage = self._stages[name]
            found = stage.found.pop(item, None) or stage.resolver.unit(item, self.states[name].members[item])
            assert found is not None, item
            if isinstance(found, Unit):
                return found
            self._block(stage, item, found)
            self._spread()
        return None

    def finish(self, unit: Unit, record: UnitRecord) -> None:
        """Enter a unit's result, which may make other units ready."""
        name = unit.entry.name
        self.states[name].items[unit.item] = record.output
        if record.items:
            self._stages[name].collections[unit.item] = record.items
        self._settle(name, unit.item)
        self._spread()

    def fail(self, unit: Unit, cause: str) -> None:
        """Record that a unit has no result."""
        self.states[unit.entry.name].failed[unit.item] = cause
        self._settle(unit.entry.name, unit.item)
        self._spread()

    def block(self, unit: Unit, reason: str) -> None:
        """Record that a unit cannot run after all."""
        self._block(self._stages[unit.entry.name], unit.item, reason)
        self._spread()

    def settled_unit(self, stage: str, item: str) -> Unit:
        """Return a unit, not of a source, that has a result, for computing it again."""
        found = self._stages[stage].resolver.unit(item, self.states[stage].members[item])
        assert isinstance(found, Unit), item
        return found

    def has_result(self, unit: Unit, record: UnitRecord) -> bool:
        """Return whether a record holds the result with which a unit was settled."""
        stage, state = self._stages[unit.entry.name], self.states[unit.entry.name]
        items = stage.collections.get(unit.item, {})
        return state.items[unit.item] == record.output and dict(items) == dict(record.items)

    def maker(self, edge: Edge, name: str) -> str:
        """Return the unit at the other end of an edge that made an item of this name."""
        if not edge.exploded:
            return name
        found = self._stages[edge.producer].collections
        return next((item for item, collection in found.items() if name in collection), WHOLE)

    def is_complete(self, stage: str) -> bool:
        """Return whether all units of a stage are settled."""
        return stage in self._complete

    def producers(self, stage: str) -> set[str]:
        """Return the stages that feed a stage."""
        return {edge.producer for edge in self._stages[stage].edges.values()}

    def position_of(self, stage: str, item: str) -> tuple[int, int]:
        """Return the position of a unit in the workflow and in the capture, for sorting."""
        found = self._stages[stage]
        if not found.rank:
            state = self.states[stage]
            found.rank = _ranks(state.members, state.failed)
        return found.position, found.rank.get(item, 0)

    def _spread(self) -> None:
        """Hand out the new tokens, until no further ones result."""
        while self._work:
            token = self._work.popleft()
            for name, item in self._waiting.pop(token, ()):
                stage = self._stages[name]
                stage.missing[item] -= 1
                if not stage.missing[item]:
                    heapq.heappush(self._ready, (stage.position, stage.rank[item], name, item))
            if token[1] is None:
                self._open_behind(token[0])

    def _open_behind(self, producer: str) -> None:
        for name, stage in self._stages.items():
            if self.states[name].open and any(edge.producer == producer for edge in stage.edges.values()):
                self._open_if_known(name)

    def _open_if_known(self, name: str) -> None:
        """List a stage's units, if those of its producers are listed and its index, or collection, exists."""
        stage, state = self._stages[name], self.states[name]
        for port, edge in stage.edges.items():
            lists_units = port == INDEX_PORT or (edge.exploded and edge.port.cardinality is Cardinality.EACH)
            if self.states[edge.producer].open or (lists_units and edge.producer not in self._complete):
                return
        if stage.entry.spec.list_items is not None:
            found = resolve_source(stage.entry, self._store, only=self._only.get(name), listing=self.listing)
            stage.found = {item: unit for item, unit in found.items() if isinstance(unit, Unit)}
            state.members.update((item, (item,)) for item in found)
            notes = {item: unit.source.notes for item, unit in stage.found.items() if unit.source}
            self._listener.source_listed(stage.entry, {item: notes.get(item, ()) for item in found})
            blocked = {item: why for item, why in found.items() if isinstance(why, str)}
        else:
            members = stage.resolver.unit_names()
            assert members is not None, name
            blocked = stage.resolver.blocked
            # There may be a million members: a dict is not copied.
            state.members = members if isinstance(members, dict) else dict(members)
        stage.rank = _ranks(state.members, blocked)
        items = list(stage.rank)
        stage.unsettled, state.open = len(items), False
        state.pending.update(items)
        self._listener.stage_opened(stage.entry)
        for item, reason in dict(blocked).items():
            self._block(stage, item, reason)
        for item in items:
            if item not in blocked:
                self._wait(stage, item)
        if not items:
            self._end(name)
        self._open_behind(name)

    def _wait(self, stage: _Stage, item: str) -> None:
        tokens = {
            (name, unit)
            for name, unit in self._needs(stage, item)
            if (name not in self._complete if unit is None else unit in self.states[name].pending)
        }
        if not tokens:
            heapq.heappush(self._ready, (stage.position, stage.rank[item], stage.entry.name, item))
            return
        stage.missing[item] = len(tokens)
        waiter = stage.entry.name, item
        for token in tokens:
            self._waiting.setdefault(token, []).append(waiter)

    def _needs(self, stage: _Stage, item: str) -> Iterator[Token]:
        for edge in stage.edges.values():
            producer, cardinality = edge.producer, edge.port.cardinality
            policy = self._stages[producer].entry.policy
            has_threshold = bool(policy.gate) or policy.min_success > 0  # what waits for it waits until it is reached
            if edge.exploded or cardinality in (Cardinality.ALL, Cardinality.NAMES) or has_threshold:
                yield producer, None
            elif cardinality is Cardinality.NEAR:
                yield from ((producer, near) for near in stage.resolver.near[item])
            else:
                yield producer, item if cardinality is Cardinality.EACH else WHOLE

    def _block(self, stage: _Stage, item: str, reason: str) -> None:
        self.states[stage.entry.name].failed[item] = reason
        self._listener.unit_blocked(stage.entry, item, reason)
        self._settle(stage.entry.name, item)

    def _settle(self, name: str, item: str) -> None:
        stage = self._stages[name]
        self.states[name].pending.discard(item)
        stage.missing.pop(item, None)
        stage.unsettled -= 1
        self._work.append((name, item))
        if not stage.unsettled:
            self._end(name)

    def _end(self, name: str) -> None:
        """Complete a stage: put its results in order, whichever came first."""
        stage, state = self._stages[name], self.states[name]
        state.items = {item: state.items[item] for item in stage.rank if item in state.items}
        state.failed = {item: state.failed[item] for item in stage.rank if item in state.failed}
        state.exploded = {key: ref for item in stage.rank for key, ref in stage.collections.get(item, {}).items()}
        state.pending, stage.missing, stage.rank = set(), {}, {}  # emptied ones would keep their memory
        self._listener.stage_complete(stage.entry)
        self._complete.add(name)
        self._work.append((name, None))


def _ranks(members: Mapping[str, object], others: Iterable[str]) -> dict[str, int]:
    """Return unit to its position: the listed units in order, then others that could not even be listed."""
    return {item: rank for rank, item in enumerate(dict.fromkeys((*members, *others)))}
