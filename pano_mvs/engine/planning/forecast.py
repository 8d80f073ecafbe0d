"""What the stages of a run are expected to take, from a plan and from the times of earlier runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PluginError
from pano_mvs.core.text import error_text
from pano_mvs.engine.cache.unit_times import CaptureSize, ExpectedUnit, UnitTimes
from pano_mvs.engine.planning.plan import DEFAULT_OPTIONS, RunOptions, StagePlan
from pano_mvs.engine.stages.params import key_fields
from pano_mvs.engine.stages.stage import INDEX_PORT, StageSpec, place_of
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow
from pano_mvs.scene import Axis

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class StageForecast:
    """What a stage is expected to take."""

    stage: str
    after: tuple[str, ...] = ()  # the stages that feed it
    cached: int = 0
    units: int | None = None  # expected number of units to compute; None if unknown
    unit_s: float | None = None  # expected seconds of one unit; None if no earlier run computed the stage
    unit_bytes: float | None = None  # expected bytes that a unit adds to the cache; None likewise
    is_temporary: bool = False  # whether the run drops its results from the cache again

    @property
    def seconds(self) -> float | None:
        """Expected seconds of its units, one after another; None if unknown."""
        if self.units == 0:
            return 0.0
        return None if self.units is None or self.unit_s is None else self.units * self.unit_s

    @property
    def stored_bytes(self) -> float | None:
        """Expected bytes in the cache, until the run drops them if the stage is temporary; None if unknown."""
        if self.units == 0:
            return 0.0
        return None if self.units is None or self.unit_bytes is None else self.units * self.unit_bytes

    @property
    def kept_bytes(self) -> float | None:
        """Expected bytes that stay in the cache after the run; None if unknown."""
        return 0.0 if self.is_temporary else self.stored_bytes


def settings_digest(entry: StageEntry) -> str:
    """Return the digest of the settings of a stage, without those that name files."""
    return digest_from_value(key_fields(entry.params)[0])


@dataclass(frozen=True, slots=True)
class Experience:
    """What earlier runs say of the stages, for a capture and a number of threads of each worker."""

    size: CaptureSize
    histories: Sequence[UnitTimes]  # times of earlier runs; the first that has samples of a stage counts
    threads: int = 1

    def first(self, ask: Callable[[UnitTimes], Answer | None]) -> Answer | None:
        """Return the answer of the first history that has one; None if nothing is known."""
        answers = (ask(history) for history in self.histories)
        return next((answer for answer in answers if answer is not None), None)

    def unit(self, entry: StageEntry, axis: Axis) -> ExpectedUnit | None:
        """Return what a unit of a stage is expected to take."""
        use, settings, whole = entry.spec.name, settings_digest(entry), axis is Axis.ONE
        return self.first(
            lambda times: times.expected_unit(use, self.size, settings=settings, threads=self.threads, whole=whole)
        )

    def units(self, plan: StagePlan, entry: StageEntry, axis: Axis, *, index: StageEntry | None) -> int | None:
        """Return the expected number of units to compute: as planned, or for an open stage by its index or experience.

        Args:
            index: the stage that decides the units; None if there is none.
        """
        images = self.size.images
        if not plan.open:
            return len(plan.run) + len(plan.may_run)
        if axis is not Axis.PAIR:
            return images
        if index is not None and index.spec.expected_units is not None:
            return int(_expected(index.spec, index.spec.expected_units, index.params, images))
        settings = settings_digest(entry)
        return self.first(lambda times: times.expected_pairs(plan.use, images, settings=settings))


def forecast(
    plans: Sequence[StagePlan],
    workflow: Workflow,
    graph: Graph,
    *,
    experience: Experience,
    options: RunOptions = DEFAULT_OPTIONS,
) -> tuple[StageForecast, ...]:
    """Return what each stage of a plan is expected to take, in the order of the plan."""
    temporary = () if graph.is_part else options.temporary_stages(workflow, graph)  # a part of a run drops nothing
    found = []
    for plan in plans:
        entry, axis, edges = workflow.stages[plan.name], graph.axes[plan.name], graph.edges[plan.name]
        index = workflow.stages[edges[INDEX_PORT].producer] if INDEX_PORT in edges else None
        unit = experience.unit(entry, axis)
        found.append(
            StageForecast(
                plan.name,
                tuple(sorted({edge.producer for edge in edges.values()})),
                cached=len(plan.cached),
                units=experience.units(plan, entry, axis, index=index),
                unit_s=None if unit is None else unit.seconds,
                unit_bytes=None if unit is None else unit.stored_bytes,
                is_temporary=plan.name in temporary,
            )
        )
    return tuple(found)


def expected_memory(workflow: Workflow, graph: Graph, experience: Experience) -> dict[str, float]:
    """Return the bytes that the units for the whole capture are expected to need in memory, by stage.

    Only stages that declare it are included, unless the workflow states the memory of a unit.
    """
    found = {}
    for name in graph.order:
        entry = workflow.stages[name]
        if entry.spec.expected_memory is not None and not entry.policy.memory_bytes:
            unit = experience.unit(entry, Axis.ONE)
            stored_bytes = 0.0 if unit is None else unit.stored_bytes
            images = experience.size.images
            found[name] = _expected(entry.spec, entry.spec.expected_memory, entry.params, images, stored_bytes)
    return found


def _expected(spec: StageSpec, function: Callable[..., float], *arguments: object) -> float:
    """Return a number that a stage expects.

    Raises:
        PluginError: if the function of a plugin fails or returns something else; it names the line.
    """
    try:
        number = float(function(*arguments))
        if not 0 <= number < np.inf:
            raise ValueError(f"{number} was returned, not a finite number of 0 or more")
    except BaseException as error:
        if spec.is_built_in or type(error) is KeyboardInterrupt:
            raise
        what = f"{place_of(error, spec)}: {type(error).__name__}: {error_text(error)}"
        raise PluginError(f"stage {spec.name} cannot say what it expects: {what}") from error
    return number


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
