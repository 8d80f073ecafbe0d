"""What a run is expected to take, by the times of earlier runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PanoMvsError, StoreError
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import UnitRecord
from pano_mvs.engine.cache.unit_times import CaptureSize, Sample, UnitTimes
from pano_mvs.engine.planning.forecast import StageForecast, forecast
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.planning.units import WHOLE, Unit
from pano_mvs.engine.running.run import Run
from pano_mvs.scene import Axis
from pano_mvs.session.progress import Forecast

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
    size, histories = run.listing.size(), (run.store.unit_times, reference_times())
    stages = forecast(plans, run.workflow, run.graph, size=size, histories=histories, threads=run.executor.threads)
    return Forecast(stages, expected_report_s(stages, size, histories))


def expected_report_s(stages: Sequence[StageForecast], size: CaptureSize, histories: Sequence[UnitTimes]) -> float:
    """Return the expected time for the report of a run; 0 if it is unknown, or nothing is computed."""
    if all(stage.units == 0 for stage in stages):
        return 0.0
    images = CaptureSize(size.images, pixels=1.0)  # the pictures in the report are small, whatever the images are
    found = (
        history.expected_unit(_REPORT, images, settings=_NO_SETTINGS, threads=1, whole=True) for history in histories
    )
    return next((report.seconds for report in found if report is not None), 0.0)


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

    def watch(_unit: Unit, _record: UnitRecord | None, _reason: str) -> None:
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
