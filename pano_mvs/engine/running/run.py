"""Run a workflow: unit by unit, each as soon as its inputs exist; what is cached is not computed again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import GateError, StoreError
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.executors.serial import SerialExecutor
from pano_mvs.engine.planning.ready_queue import Board
from pano_mvs.engine.planning.source_listing import Listing
from pano_mvs.engine.planning.units import StageState, Unit
from pano_mvs.engine.running.dispatcher import Desk
from pano_mvs.engine.running.events import Observer, RunResult, Silent
from pano_mvs.engine.running.options import NO_DEMANDS, Demands
from pano_mvs.engine.running.publish import Publisher
from pano_mvs.engine.running.scheduler import Scheduler
from pano_mvs.engine.running.statistics import Tally
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.scene import Record

GRACE_S = 10.0
"""How long units in flight may go on after an interrupt, so that their work is not lost."""

_HEALING_ROUNDS = 3


def workflow_id(workflow: Workflow) -> str:
    """Return the name under which a workflow's latest keys are remembered: its name and its stages' names."""
    return digest_from_value([workflow.name, list(workflow.stages)])


class Run:
    """One run of a workflow.

    Attributes:
        states: stage to what it made; filled while the run goes on.
        result: what happened.
    """

    def __init__(
        self,
        workflow: Workflow,
        graph: Graph,
        store: Store,
        out: Path,
        *,
        observer: Observer | None = None,
        executor: Executor | None = None,
        demands: Demands = NO_DEMANDS,
    ) -> None:
        """Prepare a run; the executor, by default a serial one with all threads, stays the caller's to close.

        Raises:
            UsageError: if the output folder cannot be written, or demands name a stage that there is not.
        """
        self.workflow, self.graph = demands.applied_to(workflow, graph)
        self.demands = demands
        self.store = store
        self.out = out
        self.observer = observer or Silent()
        self.executor = executor or SerialExecutor(store)
        self.states: dict[str, StageState] = {}
        self.result = RunResult()
        self._publisher = Publisher(out, store)
        self._desk = Desk(self.executor, store, out, workflow.plugins)
        self._listing = Listing()
        self._keys: dict[str, dict[str, str]] = {}
        self._computed: set[str] = set()
        self._refreshed: set[str] = set()
        self._last_keys = store.runs.last_keys(workflow_id(workflow)) if demands.accept_code else {}

    def execute(self, *, earlier_files: Mapping[str, str] | None = None) -> RunResult:
        """Run every stage; finished units are kept whatever happens.

        Args:
            earlier_files: file to digest as an earlier run into this folder wrote them; what this run does not
                write any more is deleted, if it finished and nobody has changed the file.

        Raises:
            InputError: if the source cannot be listed.
            StoreError: if the store or the output folder cannot be written.
            KeyboardInterrupt: if the user interrupts; units in flight were given some time to finish.
        """
        self._publisher.earlier = dict(earlier_files or {})
        self._warn_of_timeouts()
        try:
            self._execute_healing()
            for unit in self.demands.refresh:
                if ":" in unit and unit not in self._refreshed:
                    self._warn(f"--refresh {unit}: nothing was computed again, no unit of that name was reached")
            if self.result.complete and not self.graph.is_part:
                self.result.removed = self._publisher.remove_stale(self._publisher.earlier)
        except KeyboardInterrupt:
            self.result.stopped = "interrupted"
            self._let_finish()
            raise
        finally:
            self._desk.cancel()
            self._remember()
            earlier = dict(self._publisher.earlier)
            for name, aside in self._publisher.set_aside.items():
                self._warn(f"{name} was not as a run had written it: what was there is kept as {aside}")
            self.result.written = sorted(self._publisher.written)
            self.result.published = self._publisher.published
            self.result.left_over = {
                name: digest
                for name, digest in earlier.items()
                if name not in self._publisher.published and is_file(self.out / name)
            }
        return self.result

    def load(self, stage: str, kind: type[Record], item: str = "") -> Record | None:
        """Return a value that the run made, or None if there is none."""
        ref = self.states[stage].items.get(item) if stage in self.states else None
        return self.store.load(ref, kind) if ref is not None else None

    def _remember(self) -> None:
        """Keep what makes the next plan better; a run does not fail for want of it."""
        name = workflow_id(self.workflow)
        try:
            finished = self.result.exit_code in {0, 3} and not self.result.stopped and not self.graph.is_part
            self.store.runs.remember(name, self._keys, workflow=self.workflow.name, out=self.out, finished=finished)
            self.store.stat_cache.save()
        except StoreError as error:
            self._warn(f"the next run cannot be told why it computes something: {error}")

    def _execute_healing(self) -> None:
        """Run; where a cached blob turns out damaged, it has been removed: start over, which recomputes only it."""
        found: Counter[str] = Counter()
        while True:
            try:
                self._execute_once()
                return
            except DamagedBlobError as error:
                for text in dict.fromkeys(self._scheduler.damaged or [str(error)]):
                    self._warn(text)
                    found[text] += 1
                    if found[text] > _HEALING_ROUNDS:
                        raise StoreError(f"{text} again and again: check the disk, or choose another cache with "
                                         "--cache DIR")  from error  # fmt: skip
                self._scheduler.drain()

    def _execute_once(self) -> None:
        result = self.result
        result.stages, result.failures, result.rejected, result.doubts, result.stopped = [], [], {}, {}, ""
        tally = Tally(result, self.observer, lambda name: self.states[name], self._publisher.name_items)
        board = Board(self.workflow, self.graph, self.store, tally, self._listing)
        self.states = board.states
        self._scheduler = Scheduler(board, tally, self._desk, self._publisher, keys=self._keys,
                                    computed=self._computed, finder=self._find, warn=self._warn)  # fmt: skip
        stop: GateError | None = None
        self._publisher.begin_pass()
        try:
            board.start()
            with suppress(StoreError):  # so that workers need not read whole files for their digests
                self.store.stat_cache.save()
            self._scheduler.work()
        except GateError as error:
            stop = error
        finally:
            clashes = self._publisher.clash_causes()
            tally.put_in_order(board.place, replaced=self._replaced(), clashes=clashes)
        if stop is not None:
            result.stopped, result.exit_code = str(stop), stop.exit_code
        else:
            result.exit_code = 0 if result.complete and not result.doubts else 3

    def _replaced(self) -> set[str]:
        """Return the stages whose values another stage has made anew: it reads them, makes their kind, and finished."""
        stages = self.workflow.stages
        return {
            edge.producer
            for name in self.graph.order
            if name in self.states and self.states[name].items
            for edge in self.graph.edges[name].values()
            if issubclass(stages[name].spec.output, stages[edge.producer].spec.output)
        }

    def _find(self, unit: Unit) -> UnitRecord | None:
        """Return a unit's record if the store has it and nobody asked for it anew."""
        if self.demands.refreshes(unit):
            self._refreshed.add(f"{unit.entry.name}:{unit.item}")
            if unit.key not in self._computed:
                return None
        last = self._last_keys.get(unit.entry.name, {}).get(unit.item)
        return self.store.find(unit.key) or self.demands.accepted(unit, last, self.store)

    def _let_finish(self) -> None:
        """Give units in flight some time after an interrupt; a second interrupt ends it at once."""
        deadline = time.monotonic() + GRACE_S
        if self._desk and self.executor.enforces_timeouts:  # units run elsewhere, and go on
            self.observer.warn(f"interrupted: {len(self._desk)} {plural(len(self._desk), 'unit')} may finish within "
                               f"{GRACE_S:.0f} s; interrupt again to stop at once")  # fmt: skip
            while self._desk and (left := deadline - time.monotonic()) > 0:
                self._desk.take(left)

    def _warn_of_timeouts(self) -> None:
        names = [name for name, entry in self.workflow.stages.items() if entry.policy.timeout_s]
        if names and not self.executor.enforces_timeouts:
            self._warn(f"timeout_s of {', '.join(names)} is not kept: a unit in this very process cannot be ended. "
                       "Use --executor processes")  # fmt: skip

    def _warn(self, text: str) -> None:
        self.result.warnings.append(text)
        self.observer.warn(text)
