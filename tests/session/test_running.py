"""Workflows run and planned from Python: what is returned, what is reported on the way, and what is an error."""

from __future__ import annotations

from pathlib import Path

import pytest

import pano_mvs
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFailed, UnitFinished
from pano_mvs.session.progress import Event, RunFinished, RunStarted
from pano_mvs.session.python_calls import arguments_from_options, overrides_from_settings
from pano_mvs.session.running import Execution
from tests.engine.conftest import Toy


def run_toy(toy: Toy, **options: object) -> pano_mvs.RunOutput:
    """Run the toy in this process, with its cache and output folder."""
    arguments = {"out": toy.folder / "out", "cache": toy.folder / "cache", "executor": "serial", **options}
    return pano_mvs.run(toy.folder / "wf.yaml", **arguments)  # type: ignore[arg-type]  # any of its options


def test_a_run_returns_what_run_json_holds_and_a_second_one_computes_nothing(toy: Toy) -> None:
    first = run_toy(toy)
    assert first.ok
    assert first.summary.workflow.name == "toy"
    assert [stage.name for stage in first.summary.stages][:2] == ["images", "scaled"]
    assert "all.txt" in first.written
    assert first.verdict.outcome == "Finished"
    assert pano_mvs.RunSummary.read(toy.folder / "out") == first.summary
    again = run_toy(toy)
    assert (again.summary.units.run, again.summary.units.cached) == (0, first.summary.units.run)
    assert again.written == ()


def test_events_come_from_the_start_of_the_run_to_its_end(toy: Toy) -> None:
    events: list[Event] = []
    output = run_toy(toy, progress=events.append)
    assert isinstance(events[0], RunStarted)
    assert events[0].stages[0] == "images"
    end = events[-1]
    assert isinstance(end, RunFinished)
    assert (end.exit_code, end.run, end.verdict) == (0, output.summary.units.run, output.verdict)
    units = {event.stage: event.units for event in events if isinstance(event, StageStarted)}
    finished = [event.stage for event in events if isinstance(event, UnitFinished)]
    assert {stage: finished.count(stage) for stage in units} == units
    (scaled,) = [event for event in events if isinstance(event, StageFinished) and event.stage == "scaled"]
    assert (scaled.use, scaled.run, scaled.metrics["value"]) == ("toy.scale", 5, 30.0)


def test_the_last_event_of_an_interrupted_run_counts_its_units(toy: Toy) -> None:
    """It said that nothing was run and nothing was in the cache."""
    run_toy(toy, until=("scaled",))
    events: list[Event] = []

    def interrupt(event: Event) -> None:
        events.append(event)
        if isinstance(event, UnitFinished) and event.stage == "difference":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_toy(toy, progress=interrupt)
    end = events[-1]
    assert isinstance(end, RunFinished)
    stated = pano_mvs.RunSummary.read(toy.folder / "out").units
    assert (end.exit_code, end.run, end.cached) == (130, stated.run, stated.cached)
    assert end.cached == 10


def test_failed_units_are_in_the_summary_and_raise_nothing(toy: Toy) -> None:
    toy.number("3.txt", "13")
    events: list[Event] = []
    output = run_toy(toy, progress=events.append)
    assert not output.ok
    assert output.summary.exit_code == 3
    (failure,) = output.summary.failures
    assert failure.label == "scaled:3.txt"
    assert "thirteen is unlucky" in failure.cause
    assert output.summary.units.blocked == len(output.summary.blocked) > 0
    (event,) = [event for event in events if isinstance(event, UnitFailed)]
    assert (event.stage, event.item, event.cause) == (failure.stage, failure.item, failure.cause)


def test_settings_are_python_values_or_strings_as_on_the_command_line(toy: Toy) -> None:
    capture = toy.folder / "others"
    (toy.folder / "capture").rename(capture)
    output = run_toy(toy, settings={"scaled.by": 4, "images.path": capture, "all": None})
    stages = {stage.name: stage for stage in output.summary.stages}
    assert stages["scaled"].params == {"by": 4.0}
    assert "all" not in stages
    assert output.summary.workflow.overrides[0] == "scaled.by=4"
    assert overrides_from_settings({"a.b": "[1, 2]", "a.c": True, "a.d": [0.5, None]}) == [
        "a.b=[1, 2]",
        "a.c=true",
        "a.d=[0.5, null]",
    ]
    with pytest.raises(pano_mvs.UsageError, match=r"setting a\.b: object is not a value"):
        overrides_from_settings({"a.b": object()})


def test_a_plan_names_the_units_that_a_run_would_compute(toy: Toy) -> None:
    def planned(settings: dict[str, object] | None = None) -> pano_mvs.RunPlan:
        out, cache = toy.folder / "out", toy.folder / "cache"
        return pano_mvs.plan(toy.folder / "wf.yaml", out=out, cache=cache, settings=settings)

    before = planned()
    assert (len(before["images"].run), before.may_follow) == (5, True)
    assert not (toy.folder / "out").exists()
    run_toy(toy)
    after = planned()
    assert (after.units, after.may_follow) == (0, False)
    changed = planned({"scaled.by": 5})
    assert len(changed["scaled"].run) == 5


@pytest.mark.parametrize(
    ("workflow", "options", "message"),
    [
        ("nowhere.yaml", {}, "nowhere"),
        ("quickstart", {"images": "nowhere"}, "there is no such folder"),
        ("quickstart", {"settings": {"depth.plains": 3}}, "plains"),
    ],
)
def test_what_cannot_be_used_raises_our_errors(workflow: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(pano_mvs.PanoMvsError, match=message):
        pano_mvs.run(workflow, **options)  # type: ignore[arg-type]  # any of its options


def test_an_error_of_the_callback_ends_the_run_and_what_was_computed_is_kept(toy: Toy) -> None:
    def refuse(event: Event) -> None:
        if isinstance(event, StageFinished) and event.stage == "scaled":
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        run_toy(toy, progress=refuse)
    assert "enough" in pano_mvs.load(toy.folder / "out", cache=toy.folder / "cache").summary.stopped
    assert run_toy(toy).summary.units.cached >= 5


def test_the_output_of_a_folder_without_a_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(pano_mvs.InputError, match="Give the output folder of a run"):
        pano_mvs.load(tmp_path)


def test_a_disk_that_damages_results_again_and_again_ends_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def find_damage(run: object, **_: object) -> None:
        calls.append(run)
        raise DamagedBlobError("blob 7 is damaged")

    monkeypatch.setattr("pano_mvs.session.running.write_outputs", find_damage)
    with pytest.raises(DamagedBlobError, match="blob 7"):
        run_toy(toy)
    assert len(calls) == 4


def test_errors_name_arguments_and_not_options(toy: Toy) -> None:
    with pytest.raises(pano_mvs.InputError, match=r"^images=.*absent: there is no such folder"):
        run_toy(toy, images=toy.folder / "absent")
    for call in (pano_mvs.run, pano_mvs.plan):
        with pytest.raises(pano_mvs.WorkflowError, match=r"^settings\['scald.by'\]=4: no stage 'scald'") as caught:
            call(toy.folder / "wf.yaml", settings={"scald.by": 4})
        assert caught.value.problems == str(caught.value).splitlines()
    with pytest.raises(pano_mvs.UsageError, match=r"^executor=serial runs one unit .* use executor=processes$"):
        run_toy(toy, workers=3)
    (toy.folder / "file").touch()
    with pytest.raises(pano_mvs.UsageError, match="Choose another folder with out=DIR"):
        run_toy(toy, out=toy.folder / "file")


def test_execution_takes_the_place_of_the_name_of_an_executor(toy: Toy) -> None:
    assert run_toy(toy, executor=Execution("serial", threads=3)).summary.executor["threads"] == 3
    with pytest.raises(pano_mvs.UsageError, match=r"executor=slurm requires queue=FILE\.yaml"):
        run_toy(toy, executor=Execution("slurm"))


def test_only_options_become_arguments() -> None:
    message = "a--images b: --json, /x/--out y (--min-free) --workers --cache"
    assert arguments_from_options(message) == "a--images b: --json, /x/--out y ($PANO_MVS_MIN_FREE) workers cache"
