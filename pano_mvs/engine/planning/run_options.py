"""Options of a run beyond the workflow: run a part of it, or recompute some units."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.reasons import only_the_code_differs
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The options of one run.

    Attributes:
        until: the run ends after these stages; empty to run all.
        only: units, as `STAGE:ITEM`; the run is limited to them and what they need. Empty to run all.
        refresh: stages and units, as `STAGE` or `STAGE:ITEM`, that are computed again although they are cached.
        accept_code: reuse results that differ from what is needed only in the code or the libraries that computed them.
        keep_going: go on after a failed unit even if its stage says `on_error: stop`.
        isolate: compute each unit of a plugin's stage in a process of its own.
    """

    until: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    refresh: tuple[str, ...] = ()
    accept_code: bool = False
    keep_going: bool = False
    isolate: bool = False

    @property
    def is_partial(self) -> bool:
        """Whether the run is limited to some stages or units."""
        return bool(self.until or self.only)

    def applied_to(self, workflow: Workflow, graph: Graph) -> tuple[Workflow, Graph]:
        """Return the workflow and the graph with the options applied.

        Raises:
            UsageError: if an option names a stage that the workflow does not have.
        """
        for name in (*self.until, *(_stage(unit) for unit in (*self.only, *self.refresh))):
            if name not in graph.edges:
                raise UsageError(f"there is no stage {name!r} in this workflow; it has: {', '.join(graph.order)}")
        if self.keep_going:
            stages = {
                name: dataclasses.replace(entry, policy=entry.policy.model_copy(update={"on_error": "skip"}))
                for name, entry in workflow.stages.items()
            }
            workflow = dataclasses.replace(workflow, stages=stages)
        ends = {*self.until, *(_stage(unit) for unit in self.only)}
        return workflow, graph.limited_to(ends, _items_by_stage(self.only)) if ends else graph

    def refreshes(self, unit: Unit) -> bool:
        """Return whether a unit is computed again even if it is cached."""
        return unit.entry.name in self.refresh or f"{unit.entry.name}:{unit.item}" in self.refresh

    def accepted(self, unit: Unit, last_key: str | None, store: Store) -> UnitRecord | None:
        """Return what `acceptable` returns, and store it under the new key, so that the next run finds it."""
        record = self.acceptable(unit, last_key, store)
        if record is not None:
            store.put(record)
        return record

    def acceptable(self, unit: Unit, last_key: str | None, store: Store) -> UnitRecord | None:
        """Return the record of the last run for a unit if only code or libraries changed and `accept_code` is set."""
        last = store.find(last_key) if self.accept_code and last_key else None
        if last is None or not only_the_code_differs(last.identity, unit.identity):
            return None
        return dataclasses.replace(last, key=unit.key, identity=unit.identity)


DEFAULT_OPTIONS = RunOptions()


def _stage(unit: str) -> str:
    return unit.partition(":")[0]


def _items_by_stage(units: Iterable[str]) -> Mapping[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for unit in units:
        stage, _, item = unit.partition(":")
        found.setdefault(stage, set()).add(item)
    return {stage: frozenset(items) for stage, items in found.items() if "" not in items}
