"""Take units from the board, find them in the store or have them computed, and act on what comes back."""

from __future__ import annotations

from collections.abc import Callable

from pano_mvs.core.errors import ContractError, GateError, PanoMvsError, StoreError, UsageError
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.executors.protocol import Outcome
from pano_mvs.engine.executors.unit_text import input_blobs
from pano_mvs.engine.planning.ready_queue import Board
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.running.dispatcher import Desk, Ended
from pano_mvs.engine.running.events import Failure
from pano_mvs.engine.running.failures import lost
from pano_mvs.engine.running.publish import NameClashError, Publisher
from pano_mvs.engine.running.statistics import Tally
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis, Files

_STOPPING = {error.__name__: error for error in (StoreError, GateError, UsageError)}


class StoppedError(GateError):
    """What the user gave cannot be used by a stage on which all others wait."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Scheduler:
    """One pass through a workflow.

    Attributes:
        keys: stage to unit to cache key, of all units seen.
        computed: keys of what was computed rather than found, in this pass or in those before it.
        damaged: what turned out damaged in this pass, and has been removed, and the user's files that changed. Units
            that need any of it are left for the next pass, and the rest goes on: much damage takes no more passes than
            little.
    """

    def __init__(
        self,
        board: Board,
        tally: Tally,
        desk: Desk,
        publisher: Publisher,
        *,
        keys: dict[str, dict[str, str]],
        computed: set[str],
        finder: Callable[[Unit], UnitRecord | None],
        warn: Callable[[str], None],
    ) -> None:
        self.keys = keys
        self.computed = computed
        self.damaged: list[str] = []
        self._board = board
        self._tally = tally
        self._desk = desk
        self._publisher = publisher
        self._store: Store = publisher.store
        self._finder = finder
        self._warn = warn
        self._twins: dict[str, list[Unit]] = {}  # key that is being computed to other units that have the same

    def work(self) -> None:
        """Go on until every unit is settled.

        Raises:
            DamagedBlobError: if something stored turned out damaged, once nothing else can be done.
            GateError: if the workflow says that the run stops here.
            StoreError: if the store or the output folder cannot be written.
            UsageError: if workers know another version of a stage.
        """
        held: Unit | None = None  # waits for memory, and all behind it with it, so that its turn comes
        while True:
            nothing_runs = False
            if held is None and self._desk.has_room:
                unit = self._board.next_unit()
                nothing_runs = unit is None
                held = unit if unit is not None and not self._find(unit) else None
            if held is not None and self._hand_out(held):
                held = None
            if nothing_runs and not self._desk:
                if self.damaged:
                    raise DamagedBlobError(self.damaged[0])
                return
            must_wait = nothing_runs or held is not None or not self._desk.has_room
            ended = self._desk.take(None if must_wait else 0)
            if ended is not None:
                self._end(ended)

    def drain(self) -> None:
        """Wait for what is being computed; its results are in the store."""
        while (ended := self._desk.take()) is not None:
            if ended.outcome.record is not None:
                self.computed.add(ended.unit.key)

    def _find(self, unit: Unit) -> bool:
        """Settle a unit that is in the store; return whether it was, or soon will be."""
        if unit.key in self._twins:
            self._twins[unit.key].append(unit)
            return True
        self.keys.setdefault(unit.entry.name, {})[unit.item] = unit.key
        seen = len(self._store.damaged)
        record = self._finder(unit)
        for path in self._store.damaged[seen:]:
            self._warn(f"{path} is damaged; computing it again")
        if record is not None:
            self._accept(unit, record, was_computed=unit.key in self.computed)
        return record is not None

    def _hand_out(self, unit: Unit) -> bool:
        """Have a unit computed as soon as there is memory for it; return whether it is off our hands."""
        if not self._desk.fits(unit):
            if self._desk:
                return False
            self._tally.unit_started(unit.entry, unit.item)
            self._fail(Ended(unit, Outcome("failed", cause=self._desk.refusal(unit)), None, ()))
            return True
        self._twins[unit.key] = []
        self._tally.unit_started(unit.entry, unit.item)
        self._desk.hand_out(unit, siblings=len(self._board.states[unit.entry.name].members))
        return True

    def _end(self, ended: Ended) -> None:
        outcome, unit = ended.outcome, ended.unit
        twins = self._twins.pop(unit.key)
        if outcome.status == "damaged":
            self._doubt(unit)
            self.damaged.append(outcome.cause)
            return
        if outcome.status == "changed" and self._board.listing.report(outcome.changed):
            self.damaged.append(outcome.cause)
            return
        if outcome.status == "stopped":
            raise _STOPPING.get(outcome.error, PanoMvsError)(outcome.cause)
        if outcome.record is not None:
            self.computed.add(unit.key)
            self._accept(unit, outcome.record, was_computed=True)
        else:
            self._fail(ended)
        for twin in twins:
            if not self._find(twin):
                self._fail(Ended(twin, outcome, ended.log, ended.said))

    def _accept(self, unit: Unit, record: UnitRecord, *, was_computed: bool) -> None:
        if issubclass(unit.entry.spec.output, Files):
            try:
                losers = self._publisher.publish(unit.entry.name, unit.item, record.output, to=unit.entry.policy.to)
            except (NameClashError, ContractError) as error:
                self._fail(Ended(unit, Outcome("failed", cause=str(error), seconds=record.seconds), None, ()))
                for item, cause in error.losers.items() if isinstance(error, NameClashError) else ():
                    self._give_way(unit.entry, item, cause)
                return
            except DamagedBlobError as error:
                self._store.drop(record.key)
                self.damaged.append(str(error))
                return
            for item, cause in losers.items():
                self._give_way(unit.entry, item, cause)
        self._tally.unit_done(unit.entry, unit.item, record, "run" if was_computed else "cached")
        self._board.finish(unit, record)

    def _give_way(self, entry: StageEntry, item: str, cause: str) -> None:
        """List a unit as failed that had a result: its files clash with those of a unit that comes first."""
        was_computed = self.keys.get(entry.name, {}).get(item) in self.computed
        self._tally.unit_withdrawn(Failure(entry.name, item, cause, consequence=lost(entry, item)), was_computed)
        self._board.withdraw(entry.name, item, cause)
        if entry.policy.on_error == "stop":
            raise GateError(f"stage {entry.name!r} has on_error: stop, and {entry.name}:{item} failed: {cause}")

    def _doubt(self, unit: Unit) -> None:
        """Have all computed again that could have led a unit to something damaged, lest it leads there again."""
        for ref in input_blobs(unit):
            if ref.external:
                self._store.stat_cache.forget(self._store.blobs.path(ref))
        for producer in self._board.producers(unit.entry.name):
            for key in self.keys.get(producer, {}).values():
                record = self._store.read_record(key)
                if record is not None and not all(self._store.blobs.exists(ref) for ref in record.blobs()):
                    self._store.drop(key)

    def _fail(self, ended: Ended) -> None:
        """List a unit that failed; stop if the workflow wants it so, or if all others wait for it."""
        unit, outcome = ended.unit, ended.outcome
        entry = unit.entry
        failure = Failure(
            entry.name,
            unit.item,
            outcome.cause,
            outcome.trace,
            lost(entry, unit.item),
            log="" if ended.log is None else str(ended.log),
            said=ended.said,
        )
        self._tally.unit_failed(failure, outcome.seconds)
        if outcome.exit_code and self._board.states[entry.name].axis is Axis.ONE:
            raise StoppedError(f"{entry.name}: {outcome.cause}", outcome.exit_code)
        if entry.policy.on_error == "stop":
            raise GateError(f"stage {entry.name!r} has on_error: stop, and {unit.label} failed: {outcome.cause}")
        self._board.fail(unit, outcome.cause)
