"""Plan a run: what it would compute, without computing it."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PanoMvsError, StoreError
from pano_mvs.core.kernel_cache import must_compile
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.cache.unit_times import CaptureSize, Sample, UnitTimes
from pano_mvs.engine.executors.choose import shape
from pano_mvs.engine.planning.forecast import Experience, StageForecast, forecast, makespan
from pano_mvs.engine.planning.plan import RunOptions, StagePlan, make_plan
from pano_mvs.engine.planning.unit_keys import SourceListing
from pano_mvs.engine.planning.units import WHOLE, Unit
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.stage import is_only_planned
from pano_mvs.scene import Axis
from pano_mvs.session.progress import Forecast
from pano_mvs.session.python_calls import as_names, names_arguments, overrides_from_settings
from pano_mvs.session.session import Session, check_output, open_session


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a run would compute, and what that is expected to take."""

    stages: tuple[StagePlan, ...]  # in the order of the workflow
    forecasts: tuple[StageForecast, ...] = ()  # what each stage is expected to take, by earlier runs with this cache
    workers: int = 1  # number of units at a time for which `seconds` holds
    report_s: float = 0.0  # expected seconds for the report; 0 if unknown
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # group of stages to those of it in the plan

    def __getitem__(self, stage: str) -> StagePlan:
        """Return the plan of one stage.

        Raises:
            KeyError: if the workflow has no such stage.
        """
        return {plan.name: plan for plan in self.stages}[stage]

    @property
    def units(self) -> int:
        """Number of units that would be computed for certain."""
        return sum(len(plan.run) for plan in self.stages)

    @property
    def seconds(self) -> float:
        """Expected time of the run, without the stages in `unknown`."""
        known = {one.stage: one.seconds or 0.0 for one in self.forecasts}
        at_a_time = {one.stage: one.units or 1 for one in self.forecasts}
        after = {one.stage: one.after for one in self.forecasts}
        return makespan(known, at_a_time, after, workers=self.workers) + self.report_s

    @property
    def stored_bytes(self) -> float:
        """Expected size of the results that stay in the cache, without the stages in `unknown`."""
        return sum(one.kept_bytes or 0.0 for one in self.forecasts)

    @property
    def dropped_bytes(self) -> float:
        """Expected size of the results that the run stores and drops again, without the stages in `unknown`."""
        return sum(one.stored_bytes or 0.0 for one in self.forecasts if one.is_temporary)

    @property
    def unknown(self) -> tuple[str, ...]:
        """The stages that no earlier run with this cache has computed, so that nothing is known of their time."""
        return tuple(one.stage for one in self.forecasts if one.seconds is None)

    @property
    def may_run(self) -> tuple[int, bool]:
        """Number of further units that may have to be computed, and whether that of all stages is known or expected."""
        open_stages = {plan.name: len(plan.run) for plan in self.stages if plan.open}
        expected = [one for one in self.forecasts if one.stage in open_stages]
        count = sum(len(plan.may_run) for plan in self.stages if not plan.open)
        count += sum(max(0, one.units - open_stages[one.stage]) for one in expected if one.units is not None)
        return count, all(one.units is not None for one in expected)

    @property
    def may_follow(self) -> bool:
        """Whether more units may have to be computed, depending on their results."""
        return any(plan.may_run or plan.open for plan in self.stages)


@names_arguments
def plan(
    workflow: str | Path,
    images: str | Path | None = None,
    out: str | Path | None = None,
    *,
    settings: Mapping[str, object] | None = None,
    cache: str | Path | None = None,
    until: str | Sequence[str] = (),
    only: str | Sequence[str] = (),
    refresh: str | Sequence[str] = (),
    keep: Literal["all"] | None = None,
) -> RunPlan:
    """Return what `run` would compute with the same arguments; nothing is computed or written.

    >>> import pano_mvs
    >>> plan = pano_mvs.plan("quickstart", out="out", settings={"depth.planes": 192})
    >>> list(plan["depth"].run)  # after the example of `pano_mvs.run`, which has other planes
    ['000.png', '001.png', '002.png', '003.png']

    Raises:
        UsageError: if the workflow, a setting or a folder cannot be used.
        InputError: if the images cannot be listed.
    """
    session = open_session(
        workflow,
        overrides=overrides_from_settings(settings or {}),
        images=images,
        cache=cache,
        out=out,
        run_options=RunOptions(as_names(until), as_names(only), as_names(refresh), keep_all=keep == "all"),
    )
    check_output(session)
    return plan_session(session)


def plan_session(session: Session, *, workers: int = 0, threads: int = 0) -> RunPlan:
    """Return what the run of an open session would compute.

    Args:
        workers: number of units at a time, for the estimate; 0 for the default.
        threads: of each worker; 0 for the default.
    """
    store = Store(session.store_root, for_reading=True)
    workflow, graph = session.run_options.applied_to(session.workflow, session.graph)
    listing = SourceListing(with_digests=not store.is_empty)
    only_planned = is_only_planned.set(True)
    try:
        with without_collector():
            plans = make_plan(workflow, graph, store, options=session.run_options, listing=listing)
    finally:
        is_only_planned.reset(only_planned)
    with suppress(StoreError):  # a cache of other users can be read, not written
        store.stat_cache.save()
    workers, threads = shape(workers, threads)
    experience = Experience(listing.size(), (store.unit_times,), threads)
    forecasts = forecast(plans, workflow, graph, experience=experience, options=session.run_options)
    planned = {plan.name for plan in plans}
    groups = {name: tuple(one for one in group.stages if one in planned) for name, group in workflow.groups.items()}
    groups = {name: stages for name, stages in groups.items() if stages}
    return RunPlan(tuple(plans), forecasts, workers, expected_report_s(forecasts, experience), groups)


@contextmanager
def without_collector() -> Iterator[None]:
    """Suspend Python's garbage collector, since a plan creates many objects that stay, and no cycles."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


_MAX_PLANNING_S = 5.0
_REPORT = "(report)"
_NO_SETTINGS = digest_from_value(None)


class _TooLargeError(Exception):
    """Planning would delay the run."""


def forecast_run(run: Run) -> Forecast | None:
    """Return what a run is expected to take, before it begins; None if its images cannot be listed.

    Stages that no run with this cache has computed are expected to take what they took in a reference run.
    """
    try:
        plans = _plans(run)
    except DamagedBlobError as error:  # it has been removed, and the run computes it again
        run.warn(str(error))
        plans = _without_cache(run)
    except PanoMvsError:
        return None  # the run reports the error
    experience = Experience(run.listing.size(), (run.store.unit_times, reference_times()), run.executor.threads)
    stages = forecast(plans, run.workflow, run.graph, experience=experience, options=run.options)
    return Forecast(stages, expected_report_s(stages, experience), must_compile())


def expected_report_s(stages: Sequence[StageForecast], experience: Experience) -> float:
    """Return the expected time for the report of a run; 0 if it is unknown, or nothing is computed."""
    if all(stage.units == 0 for stage in stages):
        return 0.0
    size = CaptureSize(experience.size.images, pixels=1.0)  # its pictures are small, whatever the images are
    report = experience.first(
        lambda times: times.expected_unit(_REPORT, size, settings=_NO_SETTINGS, threads=1, whole=True)
    )
    return 0.0 if report is None else report.seconds


def remember_report(run: Run, seconds: float) -> None:
    """Store how long it took to write the report of a run that computed something, for the estimates of later runs."""
    if not run.result.computed:
        return
    images = run.listing.size().images
    sample = Sample(_NO_SETTINGS, 1, images, pixels=1.0, units=1, seconds=seconds, stored_bytes=0.0)
    run.store.unit_times.add(_REPORT, sample)
    with suppress(StoreError):
        run.store.unit_times.save()


@cache
def reference_times() -> UnitTimes:
    """Return the times of the shipped stages on a machine with two cores."""
    return UnitTimes(Path(__file__).with_name("reference_times.json"))


def _plans(run: Run) -> list[StagePlan]:
    """Plan a run; if this takes too long, assume that nothing is cached."""
    deadline = time.monotonic() + _MAX_PLANNING_S

    def watch(unit: Unit, record: UnitRecord | None, _reason: str) -> None:
        run.note_planned(unit, record)
        if time.monotonic() > deadline:
            raise _TooLargeError

    try:
        return make_plan(run.workflow, run.graph, run.store, options=run.options, listing=run.listing, visit=watch)
    except _TooLargeError:
        return _without_cache(run)


def _without_cache(run: Run) -> list[StagePlan]:
    """Return the plan of a run that computes everything."""
    return [
        StagePlan(name, run.workflow.stages[name].spec.name, may_run=[WHOLE])
        if run.graph.axes[name] is Axis.ONE
        else StagePlan(name, run.workflow.stages[name].spec.name, open=True)
        for name in run.graph.order
    ]
