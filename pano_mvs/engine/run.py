"""Run a workflow: stage by stage, unit by unit, what is cached is not computed again."""

from __future__ import annotations

import os
import time
import traceback
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import GateError, InputError, PanoMvsError, StoreError, UsageError
from pano_mvs.engine.blobs import DamagedBlobError
from pano_mvs.engine.events import Failure, Observer, RunResult, Silent, StageSummary
from pano_mvs.engine.execute import execute_unit
from pano_mvs.engine.plan import settle, start_state
from pano_mvs.engine.publish import Publisher
from pano_mvs.engine.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.units import Resolution, StageState, Unit, resolve
from pano_mvs.engine.wiring import Graph
from pano_mvs.engine.workflow import StageEntry, Workflow
from pano_mvs.scene import Axis, Files, Record

_HEALING_ROUNDS = 3
_SHOWN_CAUSES = 10


class _StoppedError(GateError):
    """What the user gave cannot be used by a stage on which all others wait."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def workflow_id(workflow: Workflow) -> str:
    """Return the name under which a workflow's latest keys are remembered: its name and its stages' names."""
    return digest_from_value([workflow.name, list(workflow.stages)])


def available_threads() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
        threads: int = 0,
    ) -> None:
        """Prepare a run.

        Raises:
            UsageError: if the output folder cannot be written.
        """
        self.workflow = workflow
        self.graph = graph
        self.store = store
        self.out = out
        self.observer = observer or Silent()
        self.threads = threads or available_threads()
        self.states: dict[str, StageState] = {}
        self.result = RunResult()
        self._publisher = Publisher(out, store)
        self._keys: dict[str, dict[str, str]] = {}
        self._computed: dict[str, UnitRecord] = {}
        self._seen_damage = 0

    def execute(self, *, earlier_files: Mapping[str, str] | None = None) -> RunResult:
        """Run every stage; finished units are kept whatever happens.

        Args:
            earlier_files: file to digest as an earlier run into this folder wrote them; what this run does not
                write any more is deleted, if it finished and nobody has changed the file.

        Raises:
            InputError: if the source cannot be listed.
            StoreError: if the store or the output folder cannot be written.
        """
        earlier = dict(earlier_files or {})
        try:
            self._execute_healing()
            if self.result.exit_code == 0:
                self.result.removed = self._publisher.remove_stale(earlier)
        finally:
            self._remember()
            self.result.written = self._publisher.written
            self.result.published = self._publisher.published
            self.result.left_over = {
                name: digest
                for name, digest in earlier.items()
                if name not in self._publisher.published and (self.out / name).is_file()
            }
        return self.result

    def _remember(self) -> None:
        """Keep what makes the next plan better; a run does not fail for want of it."""
        name = workflow_id(self.workflow)
        try:
            self.store.save_last_keys(name, self.store.last_keys(name) | self._keys)
            self.store.stat_cache.save()
        except StoreError as error:
            self._warn(f"the next run cannot be told why it computes something: {error}")

    def load(self, stage: str, kind: type[Record], item: str = "") -> Record | None:
        """Return a value that the run made, or None if there is none."""
        ref = self.states[stage].items.get(item) if stage in self.states else None
        return self.store.load(ref, kind) if ref is not None else None

    def _execute_healing(self) -> None:
        """Run; where a cached blob turns out damaged, it has been removed: start over, which recomputes only it."""
        found: Counter[str] = Counter()
        while True:
            try:
                self._execute_once()
                return
            except DamagedBlobError as error:
                found[str(error)] += 1
                if found[str(error)] > _HEALING_ROUNDS:
                    raise StoreError(f"{error} again and again: check the disk, or choose another cache with "
                                     "--cache DIR")  from error  # fmt: skip
                self._warn(str(error))

    def _execute_once(self) -> None:
        self.result.stages.clear()
        self.result.failures.clear()
        self.result.rejected.clear()
        self.states.clear()
        self.result.stopped = ""
        try:
            for name in self.graph.order:
                self._run_stage(self.workflow.stages[name])
        except GateError as error:
            self.result.stopped = str(error)
            self.result.exit_code = error.exit_code
            return
        if self.result.failures or self.result.rejected:
            self.result.exit_code = 3
        else:
            self.result.exit_code = 0

    def _run_stage(self, entry: StageEntry) -> None:
        started = time.perf_counter()
        name = entry.name
        resolution = resolve(entry, self.graph.axes[name], self.graph.edges[name], self.states, self.store)
        state = self.states[name] = start_state(self.graph, name, resolution)
        if entry.spec.list_items is not None:
            self._publisher.name_items(resolution.members)
        summary = StageSummary(name, entry.spec.name, len(resolution.units) + len(resolution.blocked))
        self.result.stages.append(summary)
        self.observer.stage_started(name, len(resolution.units))
        self._note_blocked(entry, resolution, summary)
        records = {unit.item: self._run_unit(unit, state, summary) for unit in resolution.units}
        self._sum_up(entry, {item: record for item, record in records.items() if record is not None}, summary)
        summary.seconds = time.perf_counter() - started
        self.observer.stage_finished(summary)
        self._require_items(entry, state)
        self._check_gates(entry, summary)

    def _require_items(self, entry: StageEntry, state: StageState) -> None:
        """Stop where a source has nothing to offer: the rest cannot go on."""
        if entry.spec.list_items is not None and not state.items:
            causes = [failure.cause for failure in self.result.failures if failure.stage == entry.name]
            shown = "".join(f"\n  {cause}" for cause in causes[:_SHOWN_CAUSES])
            raise InputError(f"{entry.name}: none of the {len(state.members)} items can be used{shown}")

    def _note_blocked(self, entry: StageEntry, resolution: Resolution, summary: StageSummary) -> None:
        is_source = entry.spec.list_items is not None
        for item, reason in resolution.blocked.items():
            self.observer.unit_finished(entry.name, item, "blocked", 0.0)
            if is_source:
                summary.failed += 1
                self._fail(Failure(entry.name, item, reason, consequence="the run goes on without this image"))
            else:
                summary.blocked += 1
                self._fail(Failure(entry.name, item, f"it {reason}", consequence=_lost(entry, item), blocked=True))

    def _run_unit(self, unit: Unit, state: StageState, summary: StageSummary) -> UnitRecord | None:
        self._keys.setdefault(unit.entry.name, {})[unit.item] = unit.key
        record, outcome = self.store.find(unit.key), "cached"
        self._report_damage()
        if record is not None and unit.key in self._computed:
            outcome = "run"
        if record is None:
            record, outcome = self._compute(unit, state), "run"
        if record is None:
            summary.failed += 1
            return None
        settle(state, unit, record)
        if issubclass(unit.entry.spec.output, Files):
            self._publish(unit, record.output)
        if outcome == "run":
            summary.run += 1
        else:
            summary.cached += 1
            self.observer.unit_finished(unit.entry.name, unit.item, "cached", 0.0)
        return record

    def _compute(self, unit: Unit, state: StageState) -> UnitRecord | None:
        """Run a unit, with its retries; a failure is listed and leaves nothing behind."""
        policy = unit.entry.policy
        for attempt in range(policy.retries + 1):
            started = time.perf_counter()
            try:
                record = execute_unit(unit, self.store, threads=self.threads)
            except (DamagedBlobError, StoreError, GateError):
                raise
            except (Exception, SystemExit) as error:
                if attempt < policy.retries:
                    continue
                failure = _failure(unit, error)
                state.failed[unit.item] = failure.cause
                self._fail(failure)
                self.observer.unit_finished(unit.entry.name, unit.item, "failed", time.perf_counter() - started)
                if self.graph.axes[unit.entry.name] is Axis.ONE and isinstance(error, InputError | UsageError):
                    raise _StoppedError(f"{unit.entry.name}: {failure.cause}", error.exit_code) from error
                if policy.on_error == "stop":
                    raise GateError(f"stage {unit.entry.name!r} has on_error: stop, and {unit.label} failed: "
                                    f"{failure.cause}")  from error  # fmt: skip
                return None
            self._computed[unit.key] = record
            self.observer.unit_finished(unit.entry.name, unit.item, "run", record.seconds)
            return record
        return None

    def _publish(self, unit: Unit, ref: ItemRef) -> None:
        self._publisher.publish(unit.entry.name, unit.item, ref, to=unit.entry.policy.to)

    def _sum_up(self, entry: StageEntry, records: Mapping[str, UnitRecord], summary: StageSummary) -> None:
        summary.unit_metrics = {item: dict(record.metrics) for item, record in records.items() if record.metrics}
        for name in sorted({name for metrics in summary.unit_metrics.values() for name in metrics}):
            values = [metrics[name] for metrics in summary.unit_metrics.values() if name in metrics]
            summary.metrics[name] = sum(values) / len(values)
        for record in records.values():
            summary.notes.extend(note for note in record.notes if note not in summary.notes)
            for image, reason in record.rejected.items():
                self.result.rejected.setdefault(image, (entry.name, reason))

    def _check_gates(self, entry: StageEntry, summary: StageSummary) -> None:
        done = summary.run + summary.cached
        if summary.units and done / summary.units < entry.policy.min_success:
            raise GateError(f"stage {entry.name!r}: {done} of {summary.units} units succeeded, min_success is "
                            f"{entry.policy.min_success}")  # fmt: skip
        for metric, least in entry.policy.gate.items():
            if metric not in summary.metrics:
                known = ", ".join(summary.metrics) or "none"
                raise GateError(f"stage {entry.name!r}: gate on {metric!r}, but it reports: {known}")
            if summary.metrics[metric] < least:
                raise GateError(f"stage {entry.name!r}: {metric} is {summary.metrics[metric]:.4g}, the gate asks for "
                                f"{least:.4g}")  # fmt: skip

    def _fail(self, failure: Failure) -> None:
        self.result.failures.append(failure)

    def _report_damage(self) -> None:
        for path in self.store.damaged[self._seen_damage :]:
            self._warn(f"{path} is damaged; computing it again")
        self._seen_damage = len(self.store.damaged)

    def _warn(self, text: str) -> None:
        self._seen_damage = len(self.store.damaged)
        self.result.warnings.append(text)
        self.observer.warn(text)


def _failure(unit: Unit, error: BaseException) -> Failure:
    """Describe a failed unit; errors raised on purpose speak for themselves, others get the line they came from."""
    consequence = _lost(unit.entry, unit.item)
    notes = "".join(f" ({note})" for note in getattr(error, "__notes__", []))
    if isinstance(error, PanoMvsError):
        return Failure(unit.entry.name, unit.item, f"{error}{notes}", consequence=consequence)
    frames = traceback.extract_tb(error.__traceback__)
    # The author of a plugin wants the line in the plugin; we want ours wherever it is.
    own = unit.entry.spec.origin.rpartition(":")[0] if unit.entry.spec.code_digest else ""
    if own and isinstance(error, ModuleNotFoundError):
        notes += " (a plugin imports the files beside it at its top, not inside functions)"
    frame = next((f for f in reversed(frames) if f.filename == own), frames[-1])
    cause = f"{frame.filename}:{frame.lineno}: {type(error).__name__}: {error}{notes}"
    trace = "".join(traceback.format_exception(error))
    return Failure(unit.entry.name, unit.item, cause, trace, consequence)


def _lost(entry: StageEntry, item: str) -> str:
    kind = entry.spec.output.kind_name()
    return f"there is no {kind} for {item}" if item else f"there is no {kind}"
