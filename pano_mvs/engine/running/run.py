"""Run a workflow: the whole flow, from the options of the run to the records for the next run.

`Run.execute` goes over the workflow in passes. If a pass finds a damaged file in the cache, or an input image that
changed, a further pass computes what depends on it; otherwise it is the last one. Each pass (`RunPass`) does this:

1. List the sources. The ready queue then finds the units of work whose inputs exist.
2. Look up each ready unit in the cache, and dispatch it to the executor if it is not there.
3. Record each result: publish its files into the output folder, count it, and enter it into the ready queue, which
   releases the units that wait for it. Record each failure likewise.

A unit whose result an earlier run has dropped counts as cached, as only its digests are needed for the keys of other
units. If a unit must be computed that reads it, it is computed again before (`pano_mvs.engine.running.dropped`).

After the last pass the run deletes files of earlier runs that no longer belong to the results, remembers the cache
keys and the digests of the input files for the next run, and drops the results of temporary stages.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pano_mvs.core.errors import ContractError, PanoMvsError, RunStoppedError, StoreError, UsageError
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.dropping import drop_results, drop_unneeded
from pano_mvs.engine.cache.maintenance import pack
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.cache.unit_times import Sample
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.execute import failed_outcome
from pano_mvs.engine.executors.protocol import Executor, JobOutcome
from pano_mvs.engine.planning.forecast import settings_digest
from pano_mvs.engine.planning.plan import DEFAULT_OPTIONS, RunOptions
from pano_mvs.engine.planning.ready_queue import ReadyQueue
from pano_mvs.engine.planning.unit_keys import SourceListing
from pano_mvs.engine.planning.units import StageState, Unit
from pano_mvs.engine.running.dispatcher import Dispatcher, FinishedJob
from pano_mvs.engine.running.dropped import DroppedResults
from pano_mvs.engine.running.events import Observer, RunResult, UnitFailed, Warned, ignore
from pano_mvs.engine.running.publish import Publisher
from pano_mvs.engine.running.statistics import RunStatistics
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.scene import Axis, Files, Record

GRACE_S = 10.0  # time for which running units may go on after an interrupt, so that their results are not lost
WAIT_S = 5.0  # time without an event after which observers are notified that the run is waiting for units
_STOPPING_ERRORS = {error.__name__: error for error in (StoreError, RunStoppedError, UsageError)}


class UnusableInputError(RunStoppedError):
    """A stage on which all others depend cannot use what the user gave it."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Run:
    """One run of a workflow: what its passes share, and what happens before and after them."""

    def __init__(
        self,
        workflow: Workflow,
        graph: Graph,
        store: Store,
        *,
        out: Path,
        observer: Observer | None = None,
        executor: Executor | None = None,
        options: RunOptions = DEFAULT_OPTIONS,
    ) -> None:
        """Prepare a run.

        Args:
            executor: computes the units; by default one after another with all threads. The caller closes it.

        Raises:
            UsageError: if the output folder cannot be written, the options name a stage that does not exist, or units
                cannot be isolated.
        """
        self.workflow, self.graph = options.applied_to(workflow, graph)
        self.options = options
        self.store = store
        self.out = out
        self.observer = observer or ignore
        self.executor = executor or SerialExecutor(store)
        self.publisher = Publisher(out, store)
        if options.isolate and not self.executor.enforces_timeouts:
            raise UsageError(f"--isolate has no effect with --executor {self.executor.name}: use another one")
        self.dispatcher = Dispatcher(self.executor, store, out=out, plugins=workflow.plugins, isolate=options.isolate)
        self.listing = SourceListing()
        self.keys: dict[str, dict[str, str]] = {}  # stage to unit to cache key, of all units that were looked up
        self.computed: dict[str, str] = {}  # key of each unit that this run computed to its stage
        self.refreshed: set[str] = set()  # labels of the units that `--refresh` named and that were reached
        self._planned: dict[str, UnitRecord] = {}
        self._has_passed = False  # whether the last pass ended without an error
        self._warnings: list[str] = []
        self._last_keys = store.runs.last_keys(workflow.id) if options.accept_code else {}
        # stages whose results the run may drop, each with those that read it
        self.temporary = options.temporary_stages(self.workflow, self.graph)
        self.is_alone: Callable[[], bool] = lambda: False  # whether no other run uses the cache, during `execute`
        self._pass = RunPass(self, self._warnings)

    @property
    def result(self) -> RunResult:
        """What happened, in the latest pass."""
        return self._pass.result

    @property
    def states(self) -> Mapping[str, StageState]:
        """Stage to its results so far, in the latest pass."""
        return self._pass.queue.states

    def execute(self, *, earlier_files: Mapping[str, str] | None = None) -> RunResult:
        """Run every stage. Finished units stay in the cache, whatever happens.

        Args:
            earlier_files: file to digest, as an earlier run wrote them into this folder. If this run finishes, it
                deletes those that it does not write itself, unless somebody has changed them.

        Raises:
            InputError: if the source cannot be listed.
            StoreError: if the cache or the output folder cannot be written.
            KeyboardInterrupt: if the user interrupts; running units get some time to finish.
        """
        self.publisher.earlier = dict(earlier_files or {})
        names = [name for name, entry in self.workflow.stages.items() if entry.policy.timeout_s]
        if names and not self.executor.enforces_timeouts:
            self.warn(
                f"timeout_s of {', '.join(names)} has no effect: a unit that runs in the main process cannot be ended. "
                "Use --executor processes"
            )
        with self.store.in_use() as self.is_alone:
            return self._executed()

    def _executed(self) -> RunResult:
        """Run every stage, while the cache is marked as in use."""
        try:
            self._execute_passes()
            self._has_passed = True
            for unit in self.options.refresh:
                if ":" in unit and unit not in self.refreshed:
                    self.warn(f"--refresh {unit}: nothing was computed again, because no unit of that name was reached")
            if not self.result.stopped and not self.graph.is_part:
                self.result.removed = self.publisher.remove_stale(self.publisher.earlier, complete=self.result.complete)
        except KeyboardInterrupt:
            self.result.stopped = "interrupted"
            deadline = time.monotonic() + GRACE_S
            if self.dispatcher and self.executor.enforces_timeouts:
                count = len(self.dispatcher)
                text = f"interrupted: {count} {plural(count, 'unit')} may finish within {GRACE_S:.0f} s"
                self.observer(Warned(f"{text}; interrupt again to stop at once"))
                while self.dispatcher and (left := deadline - time.monotonic()) > 0:
                    self.dispatcher.next_finished(left)
            raise
        finally:
            self.dispatcher.cancel()
            self._remember()
            for name, new_name in self.publisher.set_aside.items():
                self.warn(f"{name} was not as a run had written it: it was renamed to {new_name}")
            published = self.publisher.published
            self.result.written = sorted(set(self.publisher.written))
            self.result.published = published
            self.result.left_over = {
                name: digest
                for name, digest in self.publisher.earlier.items()
                if name not in published and is_file(self.out / name)
            }
        return self.result

    def load(self, stage: str, kind: type[Record], item: str = "") -> Record | None:
        """Return a value that the run made, or None if it did not make it."""
        ref = self.states[stage].items.get(item) if stage in self.states else None
        return self.store.load(ref, kind) if ref is not None else None

    def find_record(self, unit: Unit) -> UnitRecord | None:
        """Return a unit's record from the cache, unless the user asked to compute the unit again."""
        if self.options.refreshes(unit):
            self.refreshed.add(f"{unit.entry.name}:{unit.item}")
            if unit.key not in self.computed:
                return None
        last = self._last_keys.get(unit.entry.name, {}).get(unit.item)
        may_drop = unit.entry.name in self.temporary
        record = self._planned.pop(unit.key, None) or self.store.find(unit.key, or_dropped=may_drop)
        record = record or self.options.accepted(unit, last, self.store, or_dropped=may_drop)
        if record is not None and record.dropped and not may_drop:  # its blobs exist all the same: keep them
            record = replace(record, dropped=False)
            with suppress(StoreError):  # a cache of other users can be read, not written
                self.store.replace([record])
        return record

    def note_planned(self, unit: Unit, record: UnitRecord | None) -> None:
        """Keep a record that the forecast has found for `find_record`, so that it is read and checked once."""
        if record is not None and record.key == unit.key:
            self._planned[unit.key] = record

    def warn(self, text: str) -> None:
        """Add a warning to the result, and notify the observer."""
        self._warnings.append(text)
        self.observer(Warned(text))

    def _execute_passes(self) -> None:
        """Repeat the pass until it finds nothing damaged; what it finds has been removed and is computed again."""
        found: Counter[str] = Counter()
        while True:
            self._pass = RunPass(self, self._warnings)
            try:
                self._pass.execute()
                if not self.result.stopped:
                    self.publisher.require_files()
                return
            except DamagedBlobError as error:
                for text in dict.fromkeys(self._pass.damaged or [str(error)]):
                    self.warn(text)
                    found[text] += 1
                    if found[text] > 3:
                        raise StoreError(
                            f"{text} again and again: check the disk, or choose another cache with --cache DIR"
                        ) from error
                self._pass.drain()
                self._planned.clear()  # what they list may be gone

    def _remember(self) -> None:
        """Store keys, file digests and times for the next run; the run does not fail if that is impossible."""
        finished = self._has_passed and not self.result.stopped and not self.graph.is_part
        unneeded = self._pass.stored.unneeded_stages() if finished else ()
        try:
            self.store.runs.remember(
                self.workflow.id,
                self.keys,
                workflow=self.workflow.name,
                out=self.out,
                finished=finished,
                temporary=unneeded,
            )
            self.store.stat_cache.save()
            self._remember_times()
        except StoreError as error:
            self.warn(f"the next plan cannot give the reasons why units are computed: {error}")
        if unneeded and self._pass.stored.has_undropped:
            if not self.is_alone():  # the run that ends last drops and packs
                if (mark := self.store.abandoned_mark()) is not None:
                    self.warn(
                        "the results of temporary stages stay in the cache, since another run may use it. If no other "
                        f"one does, delete {mark}, which a killed run has left on another computer, and run again"
                    )
                return
            try:
                drop_unneeded(self.store)
            except StoreError as error:
                self.warn(f"the results of temporary stages stay in the cache: {error}")
        if self._has_passed and self.computed:
            try:
                pack(self.store)
            except StoreError as error:
                self.warn(f"the results stay in many files, because they could not be packed: {error}")

    def _remember_times(self) -> None:
        """Store what the units of each stage took, for the estimates of later runs."""
        computed = [summary for summary in self.result.stages if summary.run]
        if not computed:
            return
        size = self.listing.size()
        for summary in computed:
            sample = Sample(
                settings_digest(self.workflow.stages[summary.stage]),
                self.executor.threads,
                images=size.images,
                pixels=size.pixels,
                units=summary.units,
                seconds=summary.typical_unit_s,
                stored_bytes=summary.stored_bytes / summary.run,
            )
            self.store.unit_times.add(summary.use, sample)
        self.store.unit_times.save()


class RunPass:
    """One pass over a workflow, with a result and statistics of its own."""

    def __init__(self, run: Run, warnings: list[str]) -> None:
        self.result = RunResult(warnings=warnings)
        # damaged files of the cache (which have been removed) and changed input files that this pass met. Units that
        # need any of them are left to the next pass, while the others go on, so that much damage takes no more passes
        # than little.
        self.damaged: list[str] = []
        self._run = run
        self._store = run.store
        self._statistics = RunStatistics(
            self.result, run.observer, states=lambda name: self.queue.states[name], name_items=run.publisher.name_items
        )
        # the units that can run, and the results so far
        self.queue = ReadyQueue(run.workflow, run.graph, run.store, listener=self._statistics, listing=run.listing)
        self._stop: RunStoppedError | None = None
        self._duplicates: dict[str, list[Unit]] = {}  # key that is being computed to other units with the same key
        self.stored = DroppedResults(run.temporary, run.graph, run.store, queue=self.queue)

    def execute(self) -> None:
        """Settle every unit, and enter into the result how it ended.

        Raises:
            DamagedBlobError: if a stored file was damaged, once nothing else can be done.
            StoreError: if the cache or the output folder cannot be written.
            UsageError: if workers have another version of a stage.
        """
        stop: RunStoppedError | None = None
        self._run.publisher.begin_pass()
        try:
            self.queue.start()
            with suppress(StoreError):  # so that workers need not read whole files for their digests
                self._store.stat_cache.save()
            self._settle_all()
        except RunStoppedError as error:
            stop = self._stop or error
        finally:
            self._statistics.end_pass()
            self._statistics.put_in_order(
                self.queue.position_of, replaced=self._replaced(), superseded=self._superseded()
            )
        if stop is not None:
            self.result.stopped, self.result.exit_code = str(stop), stop.exit_code
        else:
            self.result.exit_code = 0 if self.result.complete and not self.result.doubts else 3

    def drain(self) -> None:
        """Wait until the running units have ended; their results are in the cache."""
        while (finished := self._run.dispatcher.next_finished()) is not None:
            if finished.outcome.record is not None:
                self._run.computed[finished.unit.key] = finished.unit.entry.name

    def _settle_all(self) -> None:
        """Take ready units and finished jobs in turn, until every unit has a result or cannot have one."""
        dispatcher = self._run.dispatcher
        held: Unit | None = None  # waits for memory, and all others behind it, so that a large unit gets its turn
        while True:
            none_ready = False
            if held is None and dispatcher.has_capacity:
                unit = self.stored.next_unit() or self.queue.next_unit()
                none_ready = unit is None
                held = unit if unit is not None and not self._take_from_cache(unit) else None
            if held is not None and (self._waits(held) or self._dispatch(held)):
                held = None
            if none_ready and not dispatcher:
                if self.damaged:
                    raise DamagedBlobError(self.damaged[0])
                if self._stop is not None:
                    raise self._stop
                return
            must_wait = none_ready or held is not None or not dispatcher.has_capacity
            finished = dispatcher.next_finished(WAIT_S if must_wait else 0)
            if finished is not None:
                self._end(finished)
            elif must_wait:
                self._run.observer(None)

    def _take_from_cache(self, unit: Unit) -> bool:
        """Settle a unit that is in the cache; return whether it is, or is being computed for another unit."""
        if unit.key in self._duplicates:
            self._duplicates[unit.key].append(unit)
            return True
        if self.stored.is_again(unit):
            again = self._store.find(unit.key)
            if again is not None:
                self._restored(unit, again)
            return again is not None
        self._run.keys.setdefault(unit.entry.name, {})[unit.item] = unit.key
        known = len(self._store.damaged)
        record = self._run.find_record(unit)
        for path in self._store.damaged[known:]:
            self._run.warn(f"{path} is damaged; computing it again")
        if record is not None:
            self._record(unit, record, was_computed=self._run.computed.get(unit.key) == unit.entry.name)
        return record is not None

    def _dispatch(self, unit: Unit) -> bool:
        """Have a unit computed if there is memory for it; return False if it has to wait."""
        dispatcher = self._run.dispatcher
        try:
            fits = dispatcher.fits(unit)
        except BaseException as error:  # of a plugin's function for its memory
            if type(error) is KeyboardInterrupt:
                raise
            self._duplicates[unit.key] = []
            self._statistics.unit_started(unit.entry, unit.item)
            self._end(FinishedJob(unit, failed_outcome(unit, self._store, error)))
            return True
        if not fits:
            if dispatcher:
                return False
            self._statistics.unit_started(unit.entry, unit.item)
            self._fail(FinishedJob(unit, JobOutcome("failed", cause=dispatcher.refusal(unit))))
            return True
        self._duplicates[unit.key] = []
        self._statistics.unit_started(unit.entry, unit.item)
        dispatcher.submit(unit, siblings=len(self.queue.states[unit.entry.name].members))
        return True

    def _end(self, finished: FinishedJob) -> None:
        outcome, unit = finished.outcome, finished.unit
        duplicates = self._duplicates.pop(unit.key)
        if outcome.status == "damaged":
            self.damaged.append(self._cause_of_damage(unit) or outcome.cause)
            return
        if outcome.status == "changed" and self._run.listing.report(outcome.changed):
            self.damaged.append(outcome.cause)
            return
        if outcome.status == "stopped":
            error = _STOPPING_ERRORS.get(outcome.error, PanoMvsError)(outcome.cause)
            if not isinstance(error, RunStoppedError) or self.queue.states[unit.entry.name].axis is not Axis.ONE:
                raise error
            if self._stop is None:
                self._run.warn(f"{unit.label} stops the run; what does not depend on it is still computed")
            self._stop = self._stop or error
            return
        if outcome.record is not None:
            self._run.computed[unit.key] = unit.entry.name
            self._record(unit, outcome.record, was_computed=True)
        else:
            self._fail(finished)
        for duplicate in duplicates:
            if not self._take_from_cache(duplicate):
                self._fail(FinishedJob(duplicate, outcome, finished.log, finished.said))

    def _cause_of_damage(self, unit: Unit) -> str:
        """Remove the incomplete records that led to a damaged file, so that they are computed again.

        Returns:
            What happened if nothing is damaged: another run has dropped results. Otherwise nothing.
        """
        is_damaged, was_dropped = False, False
        for producer in self.queue.producers(unit.entry.name):
            for key in self._run.keys.get(producer, {}).values():
                record = self._store.read_record(key)
                if record is None or all(map(self._store.blobs.exists, record.blobs())):
                    continue
                if record.dropped:
                    was_dropped = True
                else:
                    self._store.drop(key)
                    is_damaged = True
        if is_damaged or not was_dropped:
            return ""
        return f"another run has dropped what {unit.label} reads; computing it again"

    def _record(self, unit: Unit, record: UnitRecord, *, was_computed: bool) -> None:
        """Publish a result, count it, and enter it into the queue."""
        if self.stored.is_again(unit):
            self._statistics.unit_computed_again(unit.entry, unit.item, record)
            self._restored(unit, record)
            return
        if issubclass(unit.entry.spec.output, Files) and not self._publish(unit, record):
            return
        self._statistics.unit_done(unit.entry, unit.item, record, status="run" if was_computed else "cached")
        self.stored.settled(unit, record)
        self.queue.finish(unit, record)
        self._drop_early()

    def _waits(self, unit: Unit) -> bool:
        """Return whether a unit cannot be computed now, because results that it reads were dropped."""
        if cause := self.stored.failed_input(unit):
            self._block(self.stored.failed(unit) if self.stored.is_again(unit) else [unit], cause)
            return True
        return self.stored.wait(unit)

    def _restored(self, unit: Unit, record: UnitRecord) -> None:
        """Go on with the units that waited for a result that had been dropped and is back."""
        if not self.stored.restored(unit, record):
            self.damaged.append(
                f"{unit.label} has another result than the one that was dropped; what reads it is computed again"
            )

    def _block(self, units: Iterable[Unit], cause: str) -> None:
        for unit in units:
            self.queue.block(unit, f"needs {cause}, which failed")

    def _drop_early(self) -> None:
        """Drop results that no unit of the run reads any more, if they take much space."""
        run = self._run
        if self.damaged or run.graph.is_part or not self.stored.takes_much or not run.is_alone():
            return
        stages = self.stored.take_unneeded()
        others = {key for name, keys in run.keys.items() if name not in stages for key in keys.values()}
        try:
            drop_results(self._store, (key for name in stages for key in run.keys[name].values()), needed=others)
        except StoreError as error:
            run.warn(f"the results of temporary stages stay in the cache: {error}")

    def _publish(self, unit: Unit, record: UnitRecord) -> bool:
        """Write a unit's files into the output folder; return whether that was possible."""
        entry = unit.entry
        try:
            self._run.publisher.publish(entry.name, unit.item, record.output, to=entry.policy.to)
        except ContractError as error:
            self._fail(FinishedJob(unit, JobOutcome("failed", cause=str(error), seconds=record.seconds)))
            return False
        except DamagedBlobError as error:
            self._store.drop(record.key)
            self.damaged.append(str(error))
            return False
        return True

    def _fail(self, finished: FinishedJob) -> None:
        """Record a failed unit; stop the run if the workflow asks for it or if all other units depend on this one."""
        unit, outcome = finished.unit, finished.outcome
        entry = unit.entry
        failure = UnitFailed(
            entry.name,
            unit.item,
            outcome.cause,
            f"there is no {entry.spec.output.kind_name()}{f' for {unit.item}' if unit.item else ''}",
            "" if finished.log is None else str(finished.log),
            finished.said,
            outcome.trace,
        )
        was_cached = self.stored.is_again(unit)
        self.stored.note_failed(unit)
        self._statistics.unit_failed(failure, outcome.seconds, was_cached=was_cached)
        if outcome.exit_code and self.queue.states[entry.name].axis is Axis.ONE:
            raise UnusableInputError(f"{entry.name}: {outcome.cause}", outcome.exit_code)
        if entry.policy.on_error == "stop":
            raise RunStoppedError(f"stage {entry.name!r} has on_error: stop, and {unit.label} failed: {outcome.cause}")
        if was_cached:
            self._block(self.stored.failed(unit), unit.label)
        else:
            self.queue.fail(unit, outcome.cause)

    def _replaced(self) -> set[str]:
        """Return the stages whose results a finished later stage reads and replaces by its own, of the same kind."""
        stages, states = self._run.workflow.stages, self.queue.states
        return {
            edge.producer
            for name in self._run.graph.order
            if states[name].items
            for edge in self._run.graph.edges[name].values()
            if issubclass(stages[name].spec.output, stages[edge.producer].spec.output)
        }

    def _superseded(self) -> set[str]:
        """Return the stages whose value of the whole capture only led to that of a finished later stage of its kind.

        The later stage depends on the value, but is not made from it, so it does not pass on what is wrong with it.
        """
        stages, states, edges = self._run.workflow.stages, self.queue.states, self._run.graph.edges
        above: dict[str, set[str]] = {}  # the stages on which one depends
        made_from: dict[str, set[str]] = {}  # those from whose values of its kind its own is made
        found: set[str] = set()
        for name in self._run.graph.order:
            output = stages[name].spec.output
            feeding = {edge.producer for edge in edges[name].values()}
            alike = {producer for producer in feeding if issubclass(output, stages[producer].spec.output)}
            above[name] = feeding.union(*(above[producer] for producer in feeding))
            made_from[name] = alike.union(*(made_from[producer] for producer in alike))
            if output.axis is Axis.ONE and states[name].items:
                found |= {
                    other for other in above[name] - made_from[name] if issubclass(output, stages[other].spec.output)
                }
        return found
