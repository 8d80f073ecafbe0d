"""How much memory units need: what workflows, stages and inputs state. The dispatcher runs what fits together."""

from __future__ import annotations

from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.execute import arguments_of
from pano_mvs.engine.planning.units import PENDING, Unit
from pano_mvs.scene import Record


class UnitMemory:
    """The memory that units need."""

    def __init__(self, store: Store) -> None:
        """`store`: where their inputs are."""
        self._store = store
        self._loading_bytes: dict[str, int] = {}  # digest of an input to the memory that reading it takes
        self._latest = ("", 0)  # key and memory of the unit that was asked for last

    def of(self, unit: Unit) -> int:
        """Return the bytes that a unit needs; 0 if neither the workflow, the stage nor the inputs state it."""
        if self._latest[0] != unit.key:
            loading = 0 if unit.entry.policy.memory_bytes else self._loading_of(unit)
            # Every worker has as much as this for reading inputs.
            counted = loading if loading >= 300_000_000 else 0
            self._latest = unit.key, _declared(unit, self._store) + counted
        return self._latest[1]

    def _loading_of(self, unit: Unit) -> int:
        """Return the temporary memory for reading the largest of a unit's inputs."""
        found: list[tuple[ItemRef, type[Record]]] = []
        for port in unit.entry.spec.ports:
            value = unit.inputs.get(port.name)
            if value is None or port.kind.loading_bytes is Record.loading_bytes:
                continue
            refs = [value] if isinstance(value, ItemRef) else value.values()
            found.extend((ref, port.kind) for ref in refs if ref is not PENDING)
        return max((self._loading_of_item(ref, kind) for ref, kind in found), default=0)

    def _loading_of_item(self, ref: ItemRef, kind: type[Record]) -> int:
        if ref.digest not in self._loading_bytes:
            try:
                self._loading_bytes[ref.digest] = self._store.load(ref, kind).loading_bytes()
            except DamagedBlobError:
                return 0  # the unit meets the damage too, and is computed again with its inputs
        return self._loading_bytes[ref.digest]


def _declared(unit: Unit, store: Store) -> int:
    """Return the bytes that the workflow, or else the stage, declares for a unit; 0 if neither does."""
    spec, stated = unit.entry.spec, unit.entry.policy.memory_bytes
    if stated or spec.memory_needed is None:
        return stated or spec.memory_bytes
    try:
        inputs = {"item": unit.source} if unit.source is not None else arguments_of(unit, store)
        return spec.memory_needed(unit.entry.params, inputs)
    except DamagedBlobError:
        return 0  # the unit meets the damage too, and is computed again with its inputs
