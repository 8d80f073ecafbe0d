"""Keep count of a run: what each stage did, what failed, and whether what the workflow asks for was reached."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from pano_mvs.core.errors import GateError, InputError
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.store import UnitRecord
from pano_mvs.engine.planning.units import StageState
from pano_mvs.engine.running.events import Failure, Observer, Outcome, RunResult, StageSummary
from pano_mvs.engine.running.failures import lost
from pano_mvs.engine.workflows.workflow import StageEntry

_SHOWN_CAUSES = 10


@dataclass(slots=True)
class _Count:
    """A stage's summary, and of its units what goes into it once all are there."""

    summary: StageSummary
    began: float = 0.0
    metrics: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rejected: dict[str, dict[str, str]] = field(default_factory=dict)
    doubts: dict[str, dict[str, str]] = field(default_factory=dict)


class Tally:
    """Hears from the board and from the run, tells the observer, and fills in the result."""

    def __init__(
        self,
        result: RunResult,
        observer: Observer,
        states: Callable[[str], StageState],
        name_items: Callable[[Iterable[str]], None],
    ) -> None:
        self._result = result
        self._observer = observer
        self._states = states
        self._name_items = name_items
        self._counts: dict[str, _Count] = {}
        self._listed: dict[str, Mapping[str, tuple[str, ...]]] = {}

    def source_listed(self, entry: StageEntry, notes: Mapping[str, tuple[str, ...]]) -> None:
        """Pass on the names of the images, and keep what there is to say of each."""
        self._name_items(notes)
        self._listed[entry.name] = notes

    def stage_opened(self, entry: StageEntry) -> None:
        """Begin to count."""
        units = len(self._states(entry.name).pending)
        self._counts[entry.name] = _Count(StageSummary(entry.name, entry.spec.name, units), time.perf_counter())
        self._result.stages.append(self._counts[entry.name].summary)
        self._observer.stage_started(entry.name, units)

    def unit_blocked(self, entry: StageEntry, item: str, reason: str) -> None:
        """Note a unit that cannot run; of a source, it is the image itself that cannot be used.

        Raises:
            GateError: if such an image is to end the run.
        """
        summary = self._counts[entry.name].summary
        if entry.spec.list_items is not None:
            summary.failed += 1
            failure = Failure(entry.name, item, reason, consequence="the run goes on without this image")
        else:
            summary.blocked += 1
            failure = Failure(entry.name, item, f"it {reason}", consequence=lost(entry, item), blocked=True)
        self._result.failures.append(failure)
        self._observer.unit_finished(entry.name, item, "blocked", 0.0)
        if entry.spec.list_items is not None and entry.policy.on_error == "stop":
            raise GateError(f"stage {entry.name!r} has on_error: stop, and {item} cannot be used: {reason}")

    def unit_started(self, entry: StageEntry, item: str) -> None:
        """Note that a unit is being computed."""
        count = self._counts[entry.name]
        if not count.summary.run + count.summary.failed + count.summary.cached:
            count.began = time.perf_counter()
        self._observer.unit_started(entry.name, item)

    def unit_done(self, entry: StageEntry, item: str, record: UnitRecord, outcome: Outcome) -> None:
        """Note a unit with a result."""
        count = self._counts[entry.name]
        if outcome == "run":
            count.summary.run += 1
            count.summary.unit_seconds += record.seconds
        else:
            count.summary.cached += 1
        if record.metrics:
            count.metrics[item] = dict(record.metrics)
        if record.notes:
            count.notes[item] = record.notes
        if record.rejected:
            count.rejected[item] = dict(record.rejected)
        if record.doubts:
            count.doubts[item] = dict(record.doubts)
        self._observer.unit_finished(entry.name, item, outcome, record.seconds if outcome == "run" else 0.0)

    def unit_failed(self, failure: Failure, seconds: float) -> None:
        """Note a unit without a result."""
        self._counts[failure.stage].summary.failed += 1
        self._result.failures.append(failure)
        self._observer.unit_failed(failure)
        self._observer.unit_finished(failure.stage, failure.item, "failed", seconds)

    def unit_withdrawn(self, failure: Failure, was_computed: bool) -> None:
        """Note that a unit counts as failed that was noted with a result."""
        count = self._counts[failure.stage]
        count.summary.run -= was_computed
        count.summary.cached -= not was_computed
        count.summary.failed += 1
        for found in (count.metrics, count.notes, count.rejected, count.doubts):
            found.pop(failure.item, None)
        self._result.failures.append(failure)
        self._observer.unit_failed(failure)

    def stage_complete(self, entry: StageEntry) -> None:
        """Sum a stage up.

        Raises:
            InputError: if a source has nothing to offer; the rest cannot go on.
            GateError: if the stage does not reach what its entry asks for.
        """
        count, state = self._counts[entry.name], self._states(entry.name)
        summary = count.summary
        summary.seconds = time.perf_counter() - count.began
        summary.unit_metrics = {item: count.metrics[item] for item in state.items if item in count.metrics}
        for name in sorted({name for metrics in summary.unit_metrics.values() for name in metrics}):
            values = [metrics[name] for metrics in summary.unit_metrics.values() if name in metrics]
            summary.metrics[name] = sum(values) / len(values)
        listed = self._listed.get(entry.name, {})
        notes = (note for item in state.items for note in (*listed.get(item, ()), *count.notes.get(item, ())))
        summary.notes = list(dict.fromkeys(notes))
        self._observer.stage_finished(summary)
        if entry.spec.list_items is not None and not state.items:
            shown = "".join(f"\n  {cause}" for cause in list(state.failed.values())[:_SHOWN_CAUSES])
            raise InputError(
                f"{entry.name}: none of the {len(state.members)} {plural(len(state.members), 'item')} "
                f"can be used{shown}"
            )
        _check_gates(entry, summary)

    def put_in_order(
        self,
        place: Callable[[str, str], tuple[int, int]],
        *,
        replaced: Collection[str] = frozenset(),
        clashes: Mapping[tuple[str, str], str] = MappingProxyType({}),
    ) -> None:
        """Put what is told of the run into the order of the workflow and the capture, whatever came first.

        Args:
            place: returns where a unit stands in the workflow and in the capture.
            replaced: stages whose values later stages have made anew: what they doubted does not count any more.
            clashes: stage and item of units whose files clash with those of another one, to the final reason.
        """
        self._result.stages.sort(key=lambda summary: place(summary.name, ""))
        self._result.failures.sort(key=lambda failure: place(failure.stage, failure.item))
        self._result.failures[:] = [replace(failure, cause=clashes.get((failure.stage, failure.item), failure.cause))
                                    for failure in self._result.failures]  # fmt: skip
        for summary in self._result.stages:
            rejected = self._counts[summary.name].rejected
            for item in sorted(rejected, key=lambda item: place(summary.name, item)):
                for image, reason in rejected[item].items():
                    self._result.rejected.setdefault(image, (summary.name, reason))
            doubts = self._counts[summary.name].doubts if summary.name not in replaced else {}
            for item in sorted(doubts, key=lambda item: place(summary.name, item)):
                for image, reason in doubts[item].items():
                    self._result.doubts.setdefault(image, (summary.name, reason))


def _check_gates(entry: StageEntry, summary: StageSummary) -> None:
    done = summary.run + summary.cached
    if summary.units and done / summary.units < entry.policy.min_success:
        raise GateError(f"stage {entry.name!r}: {done} of {summary.units} {plural(summary.units, 'unit')} "
                        f"succeeded, min_success is {entry.policy.min_success}")  # fmt: skip
    for metric, limits in entry.policy.gate.items():
        if metric not in summary.metrics:
            known = ", ".join(summary.metrics) or "none"
            raise GateError(f"stage {entry.name!r}: gate on {metric!r}, but it reports: {known}")
        if objection := limits.objection(summary.metrics[metric]):
            raise GateError(f"stage {entry.name!r}: {metric} is {summary.metrics[metric]:.4g}, the gate asks for "
                            f"{objection}")  # fmt: skip
