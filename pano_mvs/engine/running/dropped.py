"""Results that were dropped, in a pass of a run: which are computed again, who waits for them, and what can be dropped.

A pass settles a unit whose result was dropped as if it were in the cache. A unit that has to be computed and reads such
a result is parked; what it reads is computed again, and what that reads before it. Then the parked unit goes on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.ready_queue import ReadyQueue
from pano_mvs.engine.planning.temporary import items_read
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.workflows.wiring import Graph

MUCH_BYTES = 1_000_000_000
"""Results of temporary stages are dropped during a run if they take more than this: it reads every record once."""

_Name = tuple[str, str]  # stage and item


class DroppedResults:
    """The results of the temporary stages in one pass."""

    def __init__(
        self, temporary: Mapping[str, frozenset[str]], graph: Graph, store: Store, *, queue: ReadyQueue
    ) -> None:
        """Begin with nothing.

        Args:
            temporary: stages whose results the run may drop, each with the stages that read it.
        """
        self.has_undropped = False  # whether the cache may hold a result of a temporary stage
        self._temporary = temporary
        self._graph = graph
        self._store = store
        self._queue = queue
        self._gone: dict[str, set[str]] = {}  # stage to its units that were dropped
        self._stored_bytes: dict[str, int] = {}  # temporary stage to the size of its results
        self._again: set[_Name] = set()  # units that are computed again
        self._failed_stages: set[str] = set()  # those with units that failed
        self._failed: dict[_Name, str] = {}  # units that could not be computed again, with their labels
        self._ready: deque[Unit] = deque()
        self._waiting: dict[_Name, list[Unit]] = {}  # unit that is computed again to those that wait for it
        self._missing: dict[_Name, int] = {}  # unit that waits to the number of units for which it does

    def settled(self, unit: Unit, record: UnitRecord) -> None:
        """Note a result that the cache has, or that was dropped."""
        name = unit.entry.name
        if name not in self._temporary:
            return
        if record.dropped:
            self._gone.setdefault(name, set()).add(unit.item)
        else:
            self.has_undropped = True
            stored = sum(ref.size_bytes for ref in record.own_blobs())
            self._stored_bytes[name] = self._stored_bytes.get(name, 0) + stored

    def note_failed(self, unit: Unit) -> None:
        """Note a unit that failed: the next run tries it again."""
        self._failed_stages.add(unit.entry.name)

    def next_unit(self) -> Unit | None:
        """Return a unit that is to be computed again, or that waited for one; None if there is none now."""
        return self._ready.popleft() if self._ready else None

    def is_again(self, unit: Unit) -> bool:
        """Return whether a unit is computed again because its result was dropped."""
        return (unit.entry.name, unit.item) in self._again

    def failed_input(self, unit: Unit) -> str:
        """Return a unit that cannot be computed again and whose result a unit reads; empty if there is none."""
        units = (self._failed.get(name) for name in self._needed(unit)) if self._failed else ()
        return next((label for label in units if label), "")

    def wait(self, unit: Unit) -> bool:
        """Have the dropped results that a unit reads computed again; return whether it has to wait for any."""
        needed = dict.fromkeys(self._needed(unit)) if self._gone else {}
        if not needed:
            return False
        self._missing[unit.entry.name, unit.item] = len(needed)
        for name in needed:
            self._waiting.setdefault(name, []).append(unit)
            if name not in self._again:
                again = self._queue.settled_unit(*name)
                self._again.add(name)
                self._ready.append(again)
        return True

    def restored(self, unit: Unit, record: UnitRecord) -> bool:
        """Let the units go on that wait for a unit, which was computed again; return False if its result has changed.

        Then they have other keys, and must be left to the next pass.
        """
        name = unit.entry.name, unit.item
        self._again.discard(name)
        self._gone[unit.entry.name].discard(unit.item)
        self.has_undropped = True
        if not self._queue.has_result(unit, record):
            return False
        for waiting in self._waiting.pop(name, ()):
            reader = waiting.entry.name, waiting.item
            if reader in self._missing:
                self._missing[reader] -= 1
                if not self._missing[reader]:
                    del self._missing[reader]
                    self._ready.append(waiting)
        return True

    def failed(self, unit: Unit) -> Iterator[Unit]:
        """Yield the units that cannot run because a unit could not be computed again, without such ones in between."""
        name = unit.entry.name, unit.item
        self._again.discard(name)
        self._failed[name] = unit.label
        for waiting in self._waiting.pop(name, ()):
            if self._missing.pop((waiting.entry.name, waiting.item), None) is None:
                continue  # it waits for another one that has failed, too
            if self.is_again(waiting):
                yield from self.failed(waiting)
            else:
                yield waiting

    def unneeded_stages(self) -> list[str]:
        """Return the temporary stages whose results no unit reads any more, nor would if failed units are tried again.

        What units read that only wait for failed ones is not kept: all stages below a failed unit have such units.
        """
        return [
            name
            for name, readers in self._temporary.items()
            if all(map(self._queue.is_complete, readers)) and not readers & self._failed_stages
        ]

    @property
    def takes_much(self) -> bool:
        """Whether results that no unit reads any more take more than `MUCH_BYTES`."""
        stored = self._stored_bytes
        if sum(stored.values()) < MUCH_BYTES or self._again or self._missing:
            return False
        return sum(stored.get(name, 0) for name in self.unneeded_stages()) >= MUCH_BYTES

    def take_unneeded(self) -> list[str]:
        """Return the stages whose results the run drops now, which then count as dropped."""
        stages = [name for name in self.unneeded_stages() if self._stored_bytes.pop(name, 0)]
        for name in stages:
            self._gone[name] = set(self._queue.states[name].items)
        return stages

    def _needed(self, unit: Unit) -> Iterator[_Name]:
        for edge, name, ref in items_read(unit, self._graph.edges[unit.entry.name]):
            gone = self._gone.get(edge.producer)
            if gone and not all(map(self._store.blobs.exists, ref.blobs())):
                item = self._queue.maker(edge, name)
                if item in gone:
                    yield edge.producer, item
