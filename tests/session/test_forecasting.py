"""What a run expects before it begins, and what it remembers for later ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.engine.cache.stat_cache import StatCache
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.planning.forecast import Experience
from pano_mvs.engine.running.run import Run
from pano_mvs.session import planning as forecasting
from pano_mvs.session.planning import (
    expected_report_s,
    forecast_run,
    plan_session,
    reference_times,
    remember_report,
)
from pano_mvs.session.progress import Event, Forecast, RunStarted
from pano_mvs.session.session import open_session
from tests.engine.conftest import Toy
from tests.session.test_running import run_toy


def run_of(toy: Toy) -> Run:
    session = toy.session()
    return Run(session.workflow, session.graph, Store(session.store_root), out=session.out)


def test_a_run_reports_its_forecast_first(toy: Toy) -> None:
    events: list[Event] = []
    run_toy(toy, progress=events.append)
    assert [type(event) for event in events[:2]] == [RunStarted, Forecast]
    again: list[Event] = []
    run_toy(toy, progress=again.append, settings={"scaled.by": 5})
    assert isinstance(again[1], Forecast)
    found = {stage.stage: stage for stage in again[1].stages}
    assert (found["images"].units, found["images"].cached) == (0, 5)
    assert found["scaled"].units == 5
    assert found["scaled"].unit_s is not None
    assert again[1].report_s > 0


def test_a_run_that_computes_nothing_expects_no_report_to_speak_of(toy: Toy) -> None:
    run_toy(toy)
    events: list[Event] = []
    run_toy(toy, progress=events.append)
    assert isinstance(events[1], Forecast)
    assert events[1].report_s == 0.0
    assert all(stage.units == 0 for stage in events[1].stages)


def test_images_that_cannot_be_listed_are_reported_by_the_run(toy: Toy) -> None:
    loop = "    for path in sorted(params"
    toy.edit("plug.py", lambda text: text.replace(loop, f'    raise InputError("no list")\n{loop}'))
    toy.edit("plug.py", lambda text: f"from pano_mvs.core.errors import InputError\n{text}")
    assert forecast_run(run_of(toy)) is None


def test_damage_that_planning_finds_is_a_warning_of_the_run(finished: Toy) -> None:
    store = Store(finished.folder / "cache")
    key = store.runs.last_keys(finished.session().workflow.id)["pairs"][""]
    record = store.read_record(key)
    assert record is not None
    for ref in record.blobs():
        path = Path(store.blobs.path(ref))
        path.chmod(0o644)
        path.write_bytes(b"x" * ref.size_bytes)
    run = run_of(finished)
    found = forecast_run(run)
    assert found is not None
    assert {stage.stage: stage.cached for stage in found.stages}["images"] == 0, "nothing is known of the cache"
    result = run.execute()
    assert any("damaged" in text for text in result.warnings)
    assert result.exit_code == 0


def test_planning_that_takes_too_long_expects_that_all_is_computed(
    finished: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecasting, "_MAX_PLANNING_S", -1.0)
    found = forecast_run(run_of(finished))
    assert found is not None
    units = {stage.stage: (stage.units, stage.cached) for stage in found.stages}
    assert (units["images"], units["mean"], units["shifted"], units["difference"]) == ((5, 0), (5, 0), (1, 0), (4, 0))


def test_what_the_forecast_has_found_is_not_read_again(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    run_toy(toy)
    found: list[str] = []
    find = Store.find

    def noted(store: Store, key: str, **options: bool) -> UnitRecord | None:
        found.append(key)
        return find(store, key, **options)

    monkeypatch.setattr(Store, "find", noted)
    assert run_toy(toy).summary.units.run == 0
    assert len(found) == len(set(found))


def test_a_plan_with_an_empty_cache_reads_no_file_as_a_whole(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    (toy.folder / "capture/5.txt").unlink()
    (toy.folder / "capture/5.txt").symlink_to(toy.folder)  # a folder in the place of a file
    with monkeypatch.context() as patched:
        patched.setattr(StatCache, "digest", lambda _, path: pytest.fail(f"{path} is read"))
        stages = plan_session(toy.session())
    assert list(stages["images"].run) == ["1.txt", "2.txt", "3.txt", "4.txt"]
    assert "cannot be read" in stages["images"].blocked["5.txt"]
    toy.run()
    assert list(plan_session(toy.session())["images"].cached) == ["1.txt", "2.txt", "3.txt", "4.txt"]


def test_the_report_is_remembered_only_if_something_was_computed(toy: Toy) -> None:
    size = CaptureSize(5, 2.0)
    fresh, again = run_of(toy), run_of(toy)
    fresh.execute()
    again.execute()
    stages = forecast_run(run_of(toy))
    assert stages is not None
    remember_report(again, 50.0)
    some = [stage for stage in stages.stages if stage.stage == "images"]
    assert expected_report_s(some, Experience(size, (Store(toy.folder / "cache").unit_times,))) == 0.0
    remember_report(fresh, 50.0)
    changed = toy.session("scaled.by=9")
    run = Run(changed.workflow, changed.graph, Store(changed.store_root), out=changed.out)
    found = forecast_run(run)
    assert found is not None
    assert found.report_s == 50.0


@pytest.mark.parametrize("preset", ["quickstart", "quality", "fast"])
def test_the_main_presets_have_reference_times(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A first run with a new cache shows the time left, too, if it is known of most stages."""
    monkeypatch.chdir(tmp_path)
    size = CaptureSize(10, 2e6)
    names = [entry.spec.name for entry in open_session(preset).workflow.stages.values()]
    known = [
        name
        for name in names
        if reference_times().expected_unit(name, size, settings="", threads=1, whole=False) is not None
    ]
    missing = sorted({*names} - {*known})
    assert len(known) >= 0.75 * len(names), f"run `python -m tools benchmarks reference_times {preset}`: {missing}"
    assert {"depth.sweep", "fusion.vote"} <= {*known}
    assert reference_times().expected_unit("(report)", size, settings="", threads=1, whole=True) is not None
