"""What a run is expected to take, by its plan and by the times of earlier runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import CaptureSize, Sample, UnitTimes
from pano_mvs.engine.planning.forecast import (
    Experience,
    StageForecast,
    expected_memory,
    forecast,
    makespan,
    settings_digest,
)
from pano_mvs.engine.planning.plan import make_plan
from pano_mvs.engine.planning.resolve import SourceListing
from pano_mvs.engine.workflows.workflow import Workflow
from tests.engine.conftest import Toy


def forecast_of(toy: Toy, *overrides: str) -> dict[str, StageForecast]:
    session, listing = toy.session(*overrides), SourceListing()
    store = Store(session.store_root)
    plans = make_plan(session.workflow, session.graph, store, listing=listing)
    experience = Experience(listing.size(), (store.unit_times, UnitTimes(toy.folder / "reference.json")))
    found = forecast(plans, session.workflow, session.graph, experience=experience)
    return {one.stage: one for one in found}


def test_without_experience_only_the_number_of_units_is_known(toy: Toy) -> None:
    found = forecast_of(toy)
    assert (found["images"].units, found["images"].seconds, found["images"].stored_bytes) == (5, None, None)
    assert found["mean"].units == 5, "one for each image, though the views are not known yet"
    assert found["difference"].units is None, "nothing is known of the pairs"
    assert found["shifted"].units == 1
    assert found["difference"].after == ("pairs", "scaled")


def test_a_run_leaves_times_for_the_next_one(finished: Toy) -> None:
    assert {(one.units, one.seconds, one.stored_bytes) for one in forecast_of(finished).values()} == {(0, 0.0, 0.0)}
    changed = forecast_of(finished, "scaled.by=7")
    assert (changed["images"].units, changed["scaled"].units, changed["difference"].units) == (0, 5, 4)
    for name in ("scaled", "difference", "mean", "all"):
        unit_s = changed[name].unit_s
        assert unit_s is not None, name
        assert unit_s > 0
        assert changed[name].stored_bytes
    (finished.folder / "capture" / "6.txt").write_text("60")
    more = forecast_of(finished)
    assert (more["scaled"].cached, more["scaled"].units) == (5, 1)
    assert more["difference"].units == 5, "which pairs is not known yet, but how many there were per image"


def test_open_pairs_are_expected_as_in_earlier_runs(finished: Toy) -> None:
    (finished.folder / "cache" / "records").rename(finished.folder / "records")
    found = forecast_of(finished)
    assert found["difference"].units == 4, "consecutive pairs: four of five images"


def test_the_first_history_with_the_stage_counts(toy: Toy) -> None:
    session = toy.session()
    reference = UnitTimes(toy.folder / "reference.json")
    entry = session.workflow.stages["scaled"]
    reference.add("toy.scale", Sample(settings_digest(entry), 1, 5, 2.0, 5, seconds=99.0, stored_bytes=1.0))
    reference.save()
    assert forecast_of(toy)["scaled"].unit_s == 99.0
    toy.run()
    unit_s = forecast_of(toy, "scaled.by=8")["scaled"].unit_s
    assert unit_s is not None
    assert unit_s != 99.0


def test_the_memory_of_stages_for_the_whole_capture_grows_with_it(toy: Toy) -> None:
    """Without experience, and where a stage does not declare it, nothing is known."""
    session, reference = toy.session(), UnitTimes(toy.folder / "reference.json")
    entry = session.workflow.stages["all"]
    spec = replace(entry.spec, expected_memory=lambda _params, images, stored_bytes: 1000 * images + 3 * stored_bytes)
    stages = {**session.workflow.stages, "all": replace(entry, spec=spec)}
    workflow = replace(session.workflow, stages=stages)

    def memory(images: int, workflow: Workflow = workflow) -> dict[str, float]:
        return expected_memory(workflow, session.graph, Experience(CaptureSize(images, 2.0), (reference,)))

    assert memory(10) == {"all": 10_000.0}
    reference.add(spec.name, Sample(settings_digest(entry), 1, 5, 1.0, 1, seconds=9.0, stored_bytes=100.0))
    assert memory(10) == {"all": 10_000.0 + 3 * 400.0}
    assert memory(10, session.workflow) == {}
    stated = replace(stages["all"], policy=entry.policy.model_copy(update={"memory": "2GB"}))
    assert memory(10, replace(workflow, stages={**stages, "all": stated})) == {}, "the workflow knows better"


def test_the_slowest_of_four_units_is_left_out_of_what_is_remembered(toy: Toy) -> None:
    result = toy.run()
    (summary,) = [one for one in result.stages if one.name == "scaled"]
    assert summary.run == 5
    assert summary.typical_unit_s == pytest.approx((summary.unit_seconds - summary.slowest_s) / 4)
    (single,) = [one for one in result.stages if one.name == "all"]
    assert single.typical_unit_s == single.unit_seconds


@pytest.mark.parametrize(
    ("seconds", "at_a_time", "after", "workers", "total"),
    [
        ({"a": 8.0}, {"a": 4}, {"a": ()}, 1, 8.0),
        ({"a": 8.0}, {"a": 4}, {"a": ()}, 2, 4.0),
        ({"a": 8.0}, {"a": 1}, {"a": ()}, 2, 8.0),
        ({"a": 8.0, "b": 2.0}, {"a": 4, "b": 1}, {"a": (), "b": ("a",)}, 4, 4.0),
        ({"a": 4.0, "b": 4.0}, {"a": 1, "b": 1}, {"a": (), "b": ()}, 2, 4.0),
        ({"a": 4.0, "b": 4.0, "c": 4.0}, {"a": 1, "b": 1, "c": 1}, {"a": (), "b": (), "c": ()}, 2, 8.0),
        ({"a": 4.0, "b": 0.0, "c": 4.0}, {"a": 1, "b": 0, "c": 1}, {"a": (), "b": ("a",), "c": ("b",)}, 2, 8.0),
        ({}, {}, {}, 2, 0.0),
        ({"a": 5.0}, {"a": 1}, {"a": ("elsewhere",)}, 2, 5.0),
    ],
)
def test_stages_take_turns_or_share_the_workers(
    seconds: dict[str, float], at_a_time: dict[str, int], after: dict[str, tuple[str, ...]], workers: int, total: float
) -> None:
    assert makespan(seconds, at_a_time, after, workers=workers) == pytest.approx(total)


def test_a_capture_has_the_size_of_its_largest_source(toy: Toy) -> None:
    session, listing = toy.session(), SourceListing()
    assert listing.size() == CaptureSize(0, 1.0)
    listing.items(session.workflow.stages["images"])
    assert listing.size() == CaptureSize(5, 2.0)
    assert Path(toy.folder / "capture" / "1.txt").stat().st_size == 2
