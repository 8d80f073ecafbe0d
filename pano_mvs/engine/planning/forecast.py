"""What the stages of a run are expected to take, from a plan and from the times of earlier runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.cache.unit_times import CaptureSize, ExpectedUnit, UnitTimes
from pano_mvs.engine.planning.plan import StagePlan
from pano_mvs.engine.stages.params import key_fields
from pano_mvs.engine.stages.stage import INDEX_PORT
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow
from pano_mvs.scene import Axis


@dataclass(frozen=True, slots=True)
class StageForecast:
    """What a stage is expected to take."""

    stage: str
    after: tuple[str, ...] = ()  # the stages that feed it
    cached: int = 0
    units: int | None = None  # expected number of units to compute; None if unknown
    unit_s: float | None = None  # expected seconds of one unit; None if no earlier run computed the stage
    unit_bytes: float | None = None  # expected bytes that a unit adds to the cache; None likewise

    @property
    def seconds(self) -> float | None:
        """Expected seconds of its units, one after another; None if unknown."""
        if self.units == 0:
            return 0.0
        return None if self.units is None or self.unit_s is None else self.units * self.unit_s

    @property
    def stored_bytes(self) -> float | None:
        """Expected bytes in the cache; None if unknown."""
        if self.units == 0:
            return 0.0
        return None if self.units is None or self.unit_bytes is None else self.units * self.unit_bytes


def settings_digest(entry: StageEntry) -> str:
    """Return the digest of the settings of a stage, without those that name files."""
    return digest_from_value(key_fields(entry.params)[0])


def forecast(
    plans: Sequence[StagePlan],
    workflow: Workflow,
    graph: Graph,
    *,
    size: CaptureSize,
    histories: Sequence[UnitTimes],
    threads: int,
) -> tuple[StageForecast, ...]:
    """Return what each stage of a plan is expected to take, in the order of the plan.

    Args:
        histories: times of earlier runs; the first that has samples of a stage counts.
    """
    return tuple(
        _of_stage(
            plan,
            workflow.stages[plan.name],
            index=_index_of(plan.name, workflow, graph),
            axis=graph.axes[plan.name],
            after=tuple(sorted({edge.producer for edge in graph.edges[plan.name].values()})),
            size=size,
            histories=histories,
            threads=threads,
        )
        for plan in plans
    )


def expected_memory(
    workflow: Workflow, graph: Graph, *, size: CaptureSize, histories: Sequence[UnitTimes], threads: int
) -> dict[str, float]:
    """Return the bytes that the units for the whole capture are expected to need in memory, by stage.

    Only stages that declare it are included, unless the workflow states the memory of a unit.
    """
    found = {}
    for name in graph.order:
        entry = workflow.stages[name]
        if entry.spec.expected_memory is not None and not entry.policy.memory_bytes:
            unit = _expected_unit(entry, Axis.ONE, size=size, histories=histories, threads=threads)
            stored_bytes = 0.0 if unit is None else unit.stored_bytes
            found[name] = entry.spec.expected_memory(entry.params, size.images, stored_bytes)
    return found


def _expected_unit(
    entry: StageEntry, axis: Axis, *, size: CaptureSize, histories: Sequence[UnitTimes], threads: int
) -> ExpectedUnit | None:
    """Return what a unit is expected to take, by the first history that has samples of the stage."""
    settings, whole = settings_digest(entry), axis is Axis.ONE
    found = (
        history.expected_unit(entry.spec.name, size, settings=settings, threads=threads, whole=whole)
        for history in histories
    )
    return next((one for one in found if one is not None), None)


def _of_stage(
    plan: StagePlan,
    entry: StageEntry,
    *,
    index: StageEntry | None,
    axis: Axis,
    after: tuple[str, ...],
    size: CaptureSize,
    histories: Sequence[UnitTimes],
    threads: int,
) -> StageForecast:
    unit = _expected_unit(entry, axis, size=size, histories=histories, threads=threads)
    return StageForecast(
        plan.name,
        after,
        cached=len(plan.cached),
        units=_units(plan, axis, size.images, index=index, histories=histories, settings=settings_digest(entry)),
        unit_s=None if unit is None else unit.seconds,
        unit_bytes=None if unit is None else unit.stored_bytes,
    )


def _index_of(name: str, workflow: Workflow, graph: Graph) -> StageEntry | None:
    """Return the stage that decides the units of another one; None if there is none."""
    edge = graph.edges[name].get(INDEX_PORT)
    return None if edge is None else workflow.stages[edge.producer]


def _units(
    plan: StagePlan,
    axis: Axis,
    images: int,
    *,
    index: StageEntry | None,
    histories: Sequence[UnitTimes],
    settings: str,
) -> int | None:
    """Return the expected number of units to compute: as planned, or for an open stage by its index or earlier runs."""
    if not plan.open:
        return len(plan.run) + len(plan.may_run)
    if axis is not Axis.PAIR:
        return images
    if index is not None and index.spec.expected_units is not None:
        return index.spec.expected_units(index.params, images)
    found = (history.expected_pairs(plan.use, images, settings=settings) for history in histories)
    return next((count for count in found if count is not None), None)


def makespan(
    seconds: Mapping[str, float], at_a_time: Mapping[str, int], after: Mapping[str, Sequence[str]], *, workers: int
) -> float:
    """Return the time that stages take together if each begins when those that feed it have ended.

    Stages that wait for nothing share the workers, earlier ones first.

    Args:
        seconds: stage to the time of its units, one after another, in the order of the workflow.
        at_a_time: stage to the number of its units that can be computed at a time.
        after: stage to the stages that feed it; those that are not in `seconds` have ended.
        workers: number of units that are computed at a time.
    """
    left, total_s = dict(seconds), 0.0
    while True:
        for stage in list(left):
            if left[stage] <= 0 and not any(feeding in left for feeding in after[stage]):
                del left[stage]
        rates = _rates(left, at_a_time, after, workers=workers)
        if not rates:
            return total_s
        step_s = min(left[stage] / rate for stage, rate in rates.items())
        total_s += step_s
        for stage, rate in rates.items():
            rest_s = left[stage] - rate * step_s
            left[stage] = rest_s if rest_s > 1e-9 * seconds[stage] else 0.0


def _rates(
    left: Mapping[str, float], at_a_time: Mapping[str, int], after: Mapping[str, Sequence[str]], *, workers: int
) -> dict[str, int]:
    """Return the number of workers of each stage that can begin and is not done."""
    free, rates = max(1, workers), dict[str, int]()
    for stage, left_s in left.items():
        rate = min(max(1, at_a_time[stage]), free)
        if left_s > 0 and rate > 0 and not any(feeding in left for feeding in after[stage]):
            rates[stage] = rate
            free -= rate
    return rates
