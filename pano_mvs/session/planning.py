"""Plan a run: what it would compute, without computing it."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import StoreError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import shape
from pano_mvs.engine.planning.forecast import StageForecast, forecast, makespan
from pano_mvs.engine.planning.plan import RunOptions, StagePlan, make_plan
from pano_mvs.engine.planning.resolve import SourceListing
from pano_mvs.session.forecasting import expected_report_s
from pano_mvs.session.python_calls import names_arguments, overrides_from_settings
from pano_mvs.session.session import Session, check_output, open_session


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a run would compute, and what that is expected to take.

    Attributes:
        stages: in the order of the workflow.
        forecasts: what each stage is expected to take, by earlier runs with this cache.
        workers: number of units at a time for which `seconds` holds.
        report_s: expected seconds for the report; 0 if unknown.
    """

    stages: tuple[StagePlan, ...]
    forecasts: tuple[StageForecast, ...] = ()
    workers: int = 1
    report_s: float = 0.0

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
        """Expected size of the results in the cache, without the stages in `unknown`."""
        return sum(one.stored_bytes or 0.0 for one in self.forecasts)

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
    until: Sequence[str] = (),
    only: Sequence[str] = (),
    refresh: Sequence[str] = (),
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
        run_options=RunOptions(tuple(until), tuple(only), tuple(refresh)),
    )
    check_output(session)
    return plan_session(session)


def plan_session(session: Session, *, workers: int = 0, threads: int = 0) -> RunPlan:
    """Return what the run of an open session would compute.

    Args:
        session: the session.
        workers: number of units at a time, for the estimate; 0 for the default.
        threads: of each worker; 0 for the default.
    """
    store = Store(session.store_root, for_reading=True)
    workflow, graph = session.run_options.applied_to(session.workflow, session.graph)
    listing = SourceListing()
    with without_collector():
        plans = make_plan(workflow, graph, store, options=session.run_options, listing=listing)
    with suppress(StoreError):  # a cache of other users can be read, not written
        store.stat_cache.save()
    workers, threads = shape(workers, threads)
    size, histories = listing.size(), (store.unit_times,)
    forecasts = forecast(plans, workflow, graph, size=size, histories=histories, threads=threads)
    return RunPlan(tuple(plans), forecasts, workers, expected_report_s(forecasts, size, histories))


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
