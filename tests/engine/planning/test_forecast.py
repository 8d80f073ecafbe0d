"""What a run is expected to take, by its plan and by the times of earlier runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import PluginError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import FILE_NAME, CaptureSize, ExpectedUnit, Sample, UnitTimes
from pano_mvs.engine.planning.forecast import (
    Experience,
    StageForecast,
    expected_memory,
    forecast,
    makespan,
    settings_digest,
)
from pano_mvs.engine.planning.plan import make_plan
from pano_mvs.engine.planning.unit_keys import SourceListing
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.scene.image_file import write_png
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


@pytest.mark.parametrize("wrong", ["many", None, -1, float("nan"), SystemExit(3)], ids=repr)
def test_an_expectation_that_a_plugin_cannot_give_is_its_error(toy: Toy, wrong: object) -> None:
    def expected(_params: object, _images: int, _stored_bytes: float) -> float:
        if isinstance(wrong, BaseException):
            raise wrong
        return wrong  # type: ignore[return-value]  # on purpose

    session = toy.session()
    entry = session.workflow.stages["all"]
    stages = {**session.workflow.stages, "all": replace(entry, spec=replace(entry.spec, expected_memory=expected))}
    with pytest.raises(PluginError, match=rf"stage {entry.spec.name} cannot say what it expects: .*py:\d+: "):
        expected_memory(replace(session.workflow, stages=stages), session.graph, Experience(CaptureSize(3, 2.0), ()))


def test_the_slowest_of_four_units_is_left_out_of_what_is_remembered(toy: Toy) -> None:
    result = toy.run()
    (summary,) = [one for one in result.stages if one.stage == "scaled"]
    assert summary.run == 5
    assert summary.typical_unit_s == pytest.approx((summary.unit_seconds - summary.slowest_s) / 4)
    (single,) = [one for one in result.stages if one.stage == "all"]
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


SAMPLE = Sample("a", 1, images=10, pixels=1000.0, units=10, seconds=2.0, stored_bytes=100.0)
SIZE = CaptureSize(10, 1000.0)


def times(folder: Path, *samples: Sample) -> UnitTimes:
    found = UnitTimes(folder / FILE_NAME)
    for sample in samples:
        found.add("depth", sample)
    found.save()
    return UnitTimes(folder / FILE_NAME)


def expected(found: UnitTimes, size: CaptureSize = SIZE, *, whole: bool = False, threads: int = 1) -> ExpectedUnit:
    unit = found.expected_unit("depth", size, settings="a", threads=threads, whole=whole)
    assert unit is not None
    return unit


def test_nothing_is_expected_without_experience(tmp_path: Path) -> None:
    assert times(tmp_path).expected_unit("depth", SIZE, settings="a", threads=1, whole=False) is None
    assert not (tmp_path / FILE_NAME).exists(), "nothing new, nothing written"
    found = times(tmp_path, SAMPLE)
    assert found.expected_unit("other", SIZE, settings="a", threads=1, whole=False) is None
    assert found.expected_pairs("other", 5, settings="a") is None


def test_a_unit_takes_what_one_took_scaled_by_pixels_and_for_the_whole_capture_by_images(tmp_path: Path) -> None:
    found = times(tmp_path, SAMPLE)
    assert expected(found) == ExpectedUnit(2.0, 100.0)
    assert expected(found, CaptureSize(30, 2000.0)) == ExpectedUnit(4.0, 200.0)
    assert expected(found, CaptureSize(30, 2000.0), whole=True) == ExpectedUnit(12.0, 600.0)


def test_the_same_settings_count_before_others_and_threads_and_size_after_them(tmp_path: Path) -> None:
    other_settings, other_threads = replace(SAMPLE, settings="b", seconds=50.0), replace(SAMPLE, threads=8, seconds=9.0)
    assert expected(times(tmp_path, other_settings)).seconds == 50.0, "better than nothing"
    assert expected(times(tmp_path, SAMPLE, other_settings)).seconds == 2.0
    assert expected(times(tmp_path, other_threads)).seconds == 2.0
    assert expected(times(tmp_path, other_threads), threads=8).seconds == 9.0


def test_the_median_of_the_three_most_similar_runs_counts(tmp_path: Path) -> None:
    far = [replace(SAMPLE, pixels=1e6, seconds=1e5)] * 3
    near = [replace(SAMPLE, seconds=seconds) for seconds in (1.0, 70.0, 3.0)]
    assert expected(times(tmp_path, *near, *far)).seconds == 3.0


def test_only_the_latest_eight_runs_are_kept_also_those_of_other_processes(tmp_path: Path) -> None:
    here, there = UnitTimes(tmp_path / FILE_NAME), UnitTimes(tmp_path / FILE_NAME)
    for number in range(6):
        here.add("depth", replace(SAMPLE, seconds=10.0 + number))
        there.add("depth", replace(SAMPLE, seconds=20.0 + number))
    here.save()
    there.save()
    value = json.loads((tmp_path / FILE_NAME).read_bytes().partition(b"\n")[2])
    assert [sample[5] for sample in value["depth"]] == [14.0, 15.0, 20.0, 21.0, 22.0, 23.0, 24.0, 25.0]


@pytest.mark.parametrize(("units", "images", "pairs"), [(45, 20, 190), (30, 20, 60), (30, 3, 3)])
def test_pairs_are_expected_as_all_or_as_a_number_per_image(
    tmp_path: Path, units: int, images: int, pairs: int
) -> None:
    found = times(tmp_path, replace(SAMPLE, units=units))
    assert found.expected_pairs("depth", images, settings="a") == pairs


def test_the_size_of_a_capture_is_that_of_its_pictures(tmp_path: Path) -> None:
    files = []
    for number in range(20):
        files.append((tmp_path / f"{number}.png",))
        write_png(files[-1][0], np.zeros((8, 16 if number else 400, 3), np.uint8))
    assert CaptureSize.of_files(files) == CaptureSize(20, 128.0)
    text = tmp_path / "a.txt"
    text.write_text("x" * 300)
    assert CaptureSize.of_files([(text,)]) == CaptureSize(1, 300.0)
    assert CaptureSize.of_files([(tmp_path / "gone.png",)]) == CaptureSize(1, 1.0)
    assert CaptureSize.of_files([]) == CaptureSize(0, 1.0)


BAD = [
    {"depth": [["a", 1, 10, 1000.0, 10, 2.0]]},
    {"depth": [["a", 1, 10, 0.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 10, 1.0, 10, -2.0, 1.0]]},
    {"depth": [[1, 1, 10, 1.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 1.5, 1.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 10, 1.0, 10, None, 1.0]]},
    {"depth": 3},
    [],
    None,
]


@pytest.mark.parametrize("value", BAD)
def test_what_is_not_a_sample_is_ignored(tmp_path: Path, value: object) -> None:
    body = json.dumps(value)
    (tmp_path / FILE_NAME).write_text(f"{digest_from_bytes(body.encode())}\n{body}")
    found = UnitTimes(tmp_path / FILE_NAME)
    assert found.expected_unit("depth", SIZE, settings="a", threads=1, whole=False) is None
    assert expected(times(tmp_path, SAMPLE)).seconds == 2.0, "the file is replaced"


@given(position=st.integers(0, 400), byte=st.integers(0, 255))
def test_a_changed_byte_costs_the_samples_and_nothing_else(
    tmp_path_factory: pytest.TempPathFactory, position: int, byte: int
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    times(folder, SAMPLE)
    data = bytearray((folder / FILE_NAME).read_bytes())
    position %= len(data)
    was_changed = data[position] != byte
    data[position] = byte
    (folder / FILE_NAME).write_bytes(bytes(data))
    found = UnitTimes(folder / FILE_NAME).expected_unit("depth", SIZE, settings="a", threads=1, whole=False)
    assert (found is None) == was_changed
