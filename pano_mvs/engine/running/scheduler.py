"""Take units from the queue, find them in the store or have them computed, and act on what comes back."""

from __future__ import annotations

from collections.abc import Callable

from pano_mvs.core.errors import ContractError, PanoMvsError, RunStoppedError, StoreError, UsageError
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.planning.ready_queue import ReadyQueue
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.running.dispatcher import Dispatcher, FinishedJob
from pano_mvs.engine.running.events import Failure, consequence_of
from pano_mvs.engine.running.publish import NameClashError, Publisher
from pano_mvs.engine.running.statistics import RunStatistics
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis, Files

_STOPPING = {error.__name__: error for error in (StoreError, RunStoppedError, UsageError)}


class UnusableInputError(RunStoppedError):
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
        queue: ReadyQueue,
        statistics: RunStatistics,
        dispatcher: Dispatcher,
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
        self._queue = queue
        self._statistics = statistics
        self._dispatcher = dispatcher
        self._publisher = publisher
        self._store: Store = publisher.store
        self._finder = finder
        self._warn = warn
        self._twins: dict[str, list[Unit]] = {}  # key that is being computed to other units that have the same

    def work(self) -> None:
        """Go on until every unit is settled.

        Raises:
            DamagedBlobError: if something stored turned out damaged, once nothing else can be done.
            RunStoppedError: if the workflow says that the run stops here.
            StoreError: if the store or the output folder cannot be written.
            UsageError: if workers know another version of a stage.
        """
        held: Unit | None = None  # waits for memory, and all behind it with it, so that its turn comes
        while True:
            nothing_runs = False
            if held is None and self._dispatcher.has_capacity:
                unit = self._queue.next_unit()
                nothing_runs = unit is None
                held = unit if unit is not None and not self._find(unit) else None
            if held is not None and self._submit(held):
                held = None
            if nothing_runs and not self._dispatcher:
                if self.damaged:
                    raise DamagedBlobError(self.damaged[0])
                return
            must_wait = nothing_runs or held is not None or not self._dispatcher.has_capacity
            ended = self._dispatcher.take(None if must_wait else 0)
            if ended is not None:
                self._end(ended)

    def drain(self) -> None:
        """Wait for what is being computed; its results are in the store."""
        while (ended := self._dispatcher.take()) is not None:
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

    def _submit(self, unit: Unit) -> bool:
        """Have a unit computed as soon as there is memory for it; return whether it is off our hands."""
        if not self._dispatcher.fits(unit):
            if self._dispatcher:
                return False
            self._statistics.unit_started(unit.entry, unit.item)
            self._fail(FinishedJob(unit, JobOutcome("failed", cause=self._dispatcher.refusal(unit)), None, ()))
            return True
        self._twins[unit.key] = []
        self._statistics.unit_started(unit.entry, unit.item)
        self._dispatcher.submit(unit, siblings=len(self._queue.states[unit.entry.name].members))
        return True

    def _end(self, ended: FinishedJob) -> None:
        outcome, unit = ended.outcome, ended.unit
        twins = self._twins.pop(unit.key)
        if outcome.status == "damaged":
            self._doubt(unit)
            self.damaged.append(outcome.cause)
            return
        if outcome.status == "changed" and self._queue.listing.report(outcome.changed):
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
                self._fail(FinishedJob(twin, outcome, ended.log, ended.said))

    def _accept(self, unit: Unit, record: UnitRecord, *, was_computed: bool) -> None:
        if issubclass(unit.entry.spec.output, Files):
            try:
                losers = self._publisher.publish(unit.entry.name, unit.item, record.output, to=unit.entry.policy.to)
            except (NameClashError, ContractError) as error:
                self._fail(FinishedJob(unit, JobOutcome("failed", cause=str(error), seconds=record.seconds), None, ()))
                return
            except DamagedBlobError as error:
                self._store.drop(record.key)
                self.damaged.append(str(error))
                return
            for item, cause in losers.items():
                self._give_way(unit.entry, item, cause)
        self._statistics.unit_done(unit.entry, unit.item, record, "run" if was_computed else "cached")
        self._queue.finish(unit, record)

    def _give_way(self, entry: StageEntry, item: str, cause: str) -> None:
        """List a unit as failed that had a result: its files clash with those of a unit that comes first."""
        was_computed = self.keys.get(entry.name, {}).get(item) in self.computed
        self._statistics.unit_withdrawn(
            Failure(entry.name, item, cause, consequence=consequence_of(entry, item)), was_computed
        )
        self._queue.withdraw(entry.name, item, cause)
        if entry.policy.on_error == "stop":
            raise RunStoppedError(f"stage {entry.name!r} has on_error: stop, and {entry.name}:{item} failed: {cause}")

    def _doubt(self, unit: Unit) -> None:
        """Have all computed again that could have led a unit to something damaged, lest it leads there again."""
        for ref in unit.input_blobs():
            if ref.external:
                self._store.stat_cache.forget(self._store.blobs.path(ref))
        for producer in self._queue.producers(unit.entry.name):
            for key in self.keys.get(producer, {}).values():
                record = self._store.read_record(key)
                if record is not None and not all(self._store.blobs.exists(ref) for ref in record.blobs()):
                    self._store.drop(key)

    def _fail(self, ended: FinishedJob) -> None:
        """List a unit that failed; stop if the workflow wants it so, or if all others wait for it."""
        unit, outcome = ended.unit, ended.outcome
        entry = unit.entry
        failure = Failure(
            entry.name,
            unit.item,
            outcome.cause,
            outcome.trace,
            consequence_of(entry, unit.item),
            log="" if ended.log is None else str(ended.log),
            said=ended.said,
        )
        self._statistics.unit_failed(failure, outcome.seconds)
        if outcome.exit_code and self._queue.states[entry.name].axis is Axis.ONE:
            raise UnusableInputError(f"{entry.name}: {outcome.cause}", outcome.exit_code)
        if entry.policy.on_error == "stop":
            raise RunStoppedError(f"stage {entry.name!r} has on_error: stop, and {unit.label} failed: {outcome.cause}")
        self._queue.fail(unit, outcome.cause)
