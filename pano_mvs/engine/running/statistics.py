"""Count the outcomes of each stage of a run, and check the thresholds of the workflow."""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from statistics import mean
from struct import Struct

from pano_mvs.core.errors import InputError, RunStoppedError
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.store import UnitRecord
from pano_mvs.engine.planning.units import StageState
from pano_mvs.engine.running.events import (
    Observer,
    RunResult,
    StageStarted,
    StageSummary,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    UnitStatus,
)
from pano_mvs.engine.stages.context import COUNT_IN_NOTES
from pano_mvs.engine.workflows.workflow import StageEntry


class RunStatistics:
    """Receives events from the queue and from the run, notifies the observer, and fills in the result."""

    def __init__(
        self,
        result: RunResult,
        observer: Observer,
        *,
        states: Callable[[str], StageState],
        name_items: Callable[[Iterable[str]], None],
    ) -> None:
        """Prepare to count.

        Args:
            result: is filled in.
            name_items: is called with the names of a source's images once they are known.
        """
        self._result = result
        self._observer = observer
        self._states = states
        self._name_items = name_items
        self._summaries: dict[str, StageSummary] = {}
        self._running: dict[str, set[str]] = {}  # stage to its units that are being computed
        self._began: dict[str, float] = {}  # stage to the time since when there are any
        self._source_notes: dict[str, Mapping[str, tuple[str, ...]]] = {}
        self._again: set[str] = set()  # stages with units that were computed again

    def source_listed(self, entry: StageEntry, notes: Mapping[str, tuple[str, ...]]) -> None:
        """Pass on the names of the images, and keep the notes on each."""
        self._name_items(notes)
        self._source_notes[entry.name] = notes

    def stage_opened(self, entry: StageEntry) -> None:
        """Begin to count a stage's units."""
        units = len(self._states(entry.name).pending)
        self._running[entry.name] = set()
        self._summaries[entry.name] = summary = StageSummary(entry.name, entry.spec.name, units)
        self._result.stages.append(summary)
        self._observer(StageStarted(entry.name, units))

    def unit_blocked(self, entry: StageEntry, item: str, reason: str) -> None:
        """Count a unit that cannot run; in a source, it is an image that cannot be used.

        Raises:
            RunStoppedError: if the workflow says that such an image ends the run.
        """
        summary = self._summaries[entry.name]
        if entry.spec.list_items is not None:
            summary.failed += 1
            consequence = "the run goes on without this image"
            self._result.failures.append(UnitFailed(entry.name, item, reason, consequence))
        else:
            summary.blocked += 1
            self._result.blocked.append(UnitFailed(entry.name, item, f"it {reason}"))
        self._observer(UnitFinished(entry.name, item, "blocked", 0.0))
        if entry.spec.list_items is not None and entry.policy.on_error == "stop":
            raise RunStoppedError(f"stage {entry.name!r} has on_error: stop, and {item} cannot be used: {reason}")

    def unit_started(self, entry: StageEntry, item: str) -> None:
        """Record that a unit is being computed."""
        if not self._running[entry.name]:
            self._began[entry.name] = time.perf_counter()
        self._running[entry.name].add(item)
        self._observer(UnitStarted(entry.name, item))

    def unit_done(self, entry: StageEntry, item: str, record: UnitRecord, *, status: UnitStatus) -> None:
        """Count a unit with a result."""
        summary = self._stop_clock(entry.name, item)
        if status == "run":
            summary.run += 1
            summary.unit_seconds += record.seconds
            summary.slowest_s = max(summary.slowest_s, record.seconds)
            summary.stored_bytes += sum({ref.digest: ref.size_bytes for ref in record.own_blobs()}.values())
        else:
            summary.cached += 1
        if record.metrics:
            summary.unit_metrics[item] = PackedFigures(record.metrics)
        if record.notes:
            summary.unit_notes[item] = record.notes
        if record.rejected:
            summary.rejected[item] = record.rejected
        if record.doubts:
            summary.doubts[item] = record.doubts
        seconds = round(record.seconds, 6) if status == "run" else 0.0
        self._observer(UnitFinished(entry.name, item, status, seconds))

    def unit_computed_again(self, entry: StageEntry, item: str, record: UnitRecord) -> None:
        """Count a unit as computed that counted as cached, because its result had been dropped."""
        summary = self._summaries[entry.name]
        summary.cached -= 1
        self._again.add(entry.name)
        for found in (summary.unit_metrics, summary.unit_notes, summary.rejected, summary.doubts):
            found.pop(item, None)
        self.unit_done(entry, item, record, status="run")

    def end_pass(self) -> None:
        """Notify the observer of the stages with units that were computed again after the stage had finished."""
        for name in sorted(self._again):
            self._observer(self._summaries[name].event())
        self._again.clear()

    def unit_failed(self, failure: UnitFailed, seconds: float, *, was_cached: bool = False) -> None:
        """Count a unit without a result.

        Args:
            was_cached: whether it counted as cached, because its result had been dropped.
        """
        summary = self._stop_clock(failure.stage, failure.item)
        summary.cached -= was_cached
        summary.failed += 1
        self._result.failures.append(failure)
        self._observer(failure)
        self._observer(UnitFinished(failure.stage, failure.item, "failed", round(seconds, 6)))

    def stage_complete(self, entry: StageEntry) -> None:
        """Complete the summary of a stage.

        Raises:
            InputError: if no image of a source can be used, so that the run cannot go on.
            RunStoppedError: if the stage does not reach the thresholds in its entry.
        """
        summary, state = self._summaries[entry.name], self._states(entry.name)
        found = summary.unit_metrics
        summary.unit_metrics = {item: found[item] for item in state.items if item in found}
        values: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))
        for metrics in summary.unit_metrics.values():
            for name, value in metrics.items():
                values[name].append(value)
        summary.metrics = {name: _mean(values[name]) for name in sorted(values)}
        source_notes = self._source_notes.get(entry.name, {})
        notes = (
            note for item in state.items for note in (*source_notes.get(item, ()), *summary.unit_notes.get(item, ()))
        )
        total = len(state.items)
        summary.notes = [
            note.replace(COUNT_IN_NOTES, f"{units:,} of {total:,}", 1) if note.startswith(COUNT_IN_NOTES) else note
            for note, units in Counter(notes).items()
        ]
        self._observer(summary.event())
        if entry.spec.list_items is not None and not state.items:
            shown = "".join(f"\n  {cause}" for cause in list(state.failed.values())[:10])
            listed = len(state.members)
            raise InputError(f"{entry.name}: none of the {listed} {plural(listed, 'item')} can be used{shown}")
        done = summary.run + summary.cached
        if summary.units and done / summary.units < entry.policy.min_success:
            raise RunStoppedError(
                f"stage {entry.name!r}: {done} of {summary.units} {plural(summary.units, 'unit')} succeeded, "
                f"min_success is {entry.policy.min_success}"
            )
        for metric, limits in entry.policy.gate.items():
            if metric not in summary.metrics:
                known = ", ".join(summary.metrics) or "none"
                raise RunStoppedError(f"stage {entry.name!r}: `gate` names {metric!r}, but the stage reports: {known}")
            if objection := limits.objection(summary.metrics[metric]):
                raise RunStoppedError(
                    f"stage {entry.name!r}: {metric} is {summary.metrics[metric]:.4g}, but `gate` requires {objection}"
                )

    def _stop_clock(self, stage: str, item: str) -> StageSummary:
        """Add the time since a unit began, unless others of its stage are still being computed; return the summary."""
        summary, running = self._summaries[stage], self._running[stage]
        if item in running:
            running.discard(item)
            if not running:
                summary.seconds += time.perf_counter() - self._began[stage]
        return summary

    def put_in_order(
        self,
        position_of: Callable[[str, str], tuple[int, int]],
        *,
        replaced: Collection[str] = frozenset(),
        superseded: Collection[str] = frozenset(),
    ) -> None:
        """Sort the result by workflow and capture, so that it does not depend on which unit ended first.

        Args:
            position_of: returns the position of a unit in the workflow and in the capture.
            replaced: stages whose results later stages replaced: their doubts do not count any more.
            superseded: stages whose results only led to those that count: neither do the images that they left out.
        """
        result = self._result
        result.stages.sort(key=lambda summary: position_of(summary.stage, ""))
        for units in (result.failures, result.blocked):
            units.sort(key=lambda unit: position_of(unit.stage, unit.item))

        def enter(stage: str, found: Mapping[str, Mapping[str, str]], reasons: dict[str, tuple[str, str]]) -> None:
            for item in sorted(found, key=lambda item: position_of(stage, item)):
                for image, reason in found[item].items():
                    reasons.setdefault(image, (stage, reason))

        for summary in result.stages:
            if summary.stage in superseded:
                continue
            enter(summary.stage, summary.rejected, result.rejected)
            enter(summary.stage, {} if summary.stage in replaced else summary.doubts, result.doubts)


def _mean(values: Sequence[float]) -> float:
    """Return the mean of finite values, which is finite even if their sum is not."""
    total = sum(values)
    return total / len(values) if math.isfinite(total) else mean(values)


_positions: dict[tuple[str, ...], tuple[dict[str, int], Struct]] = {}


class PackedFigures(Mapping[str, float]):
    """Figures by name; equal to a dict with the same entries."""

    __slots__ = ("_form", "_packed")

    def __init__(self, figures: Mapping[str, float]) -> None:
        """Pack figures; those with the same names share the names."""
        names = tuple(figures)
        if names not in _positions:
            _positions[names] = {name: idx for idx, name in enumerate(names)}, Struct(f"{len(names)}d")
        self._form = _positions[names]
        self._packed = self._form[1].pack(*figures.values())

    def __getitem__(self, name: str) -> float:
        positions, layout = self._form
        figures: tuple[float, ...] = layout.unpack(self._packed)
        return figures[positions[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._form[0])

    def __len__(self) -> int:
        return len(self._form[0])

    def __repr__(self) -> str:
        return repr(dict(self))
