"""Workflows run and planned from Python: what is returned, reported on the way and written, and what is an error."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

import pano_mvs
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import (
    StageFinished,
    StageStarted,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    Warned,
    ignore,
)
from pano_mvs.results.records import Finding, PairLink, Tile, Verdict
from pano_mvs.scene import TwoView
from pano_mvs.session.progress import (
    EVENTS_FILE,
    BlockStarted,
    Divided,
    Event,
    EventLog,
    EventReader,
    Forecast,
    KernelsCompiled,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
    event_from_line,
    line_from_event,
)
from pano_mvs.session.python_calls import arguments_from_options, overrides_from_settings
from pano_mvs.session.running import Execution
from pano_mvs.session.summarise import pair_links
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
    plain = {"a.b": "[1, 2]", "a.c": True, "a.d": [0.5, None], "a.e": Path("a #1"), "a.f": None, "a": None}
    assert overrides_from_settings(plain) == [
        *("a.b=[1, 2]", "a.c=true", "a.d=[0.5, null]"),
        *("a.e=a #1", "a.f=", "a=null"),
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
    with pytest.raises(pano_mvs.UsageError, match=r"there is no executor 'nothing'; known: serial, processes"):
        run_toy(toy, executor=Execution("nothing"))


def test_only_options_become_arguments() -> None:
    message = "a--images b: --json, /x/--out y (--min-free) --workers --cache"
    assert arguments_from_options(message) == "a--images b: --json, /x/--out y ($PANO_MVS_MIN_FREE) workers cache"


VERDICT = Verdict("fair", "Finished", "Usable.", "4 units.", (Tile("images", "4"),), (Finding("fair", "blurred"),))
EVENTS: tuple[Event, ...] = (
    RunStarted("lobby", ("images", "depth"), "slurm", workers=3, threads=2, out=Path("out"), cache=Path("/cache")),
    Forecast((StageForecast("depth", ("images",), 1, None, 2.5, None),), report_s=3.0),
    KernelsCompiled(3, 1.5),
    WorkersChanged(2),
    StageStarted("depth", 4),
    UnitStarted("depth", "ä\u2028.png"),
    UnitFailed("depth", "b.png", "too dark", "there is no range", "logs/b.log", ("line", "\x1b")),
    UnitFinished("depth", "a.png", "run", 1.25),
    StageFinished("depth", "depth.sweep", 4, 3, 0, 1, 0, 2.0, 4.0, {"kept": 0.5}),
    TimeLeft(12.5, at_least=True, done=0.25, unknown=("depth",)),
    Warned("disk"),
    Divided("26 panoramas are run in 3 blocks"),
    BlockStarted("block_2", 2, 3, images=12, images_left=12),
    RunFinished(3, "", run=3, failed=1, seconds=9.0, out=Path("out"), verdict=VERDICT, doubts={"a": "b"}),
)


def test_a_line_has_the_fields_of_the_event() -> None:
    line = json.loads(line_from_event(UnitFinished("depth", "a.png", "run", 1.25)))
    del line["time"]
    assert line == {"event": "unit_finished", "stage": "depth", "item": "a.png", "outcome": "run", "seconds": 1.25}


def test_every_event_comes_back() -> None:
    assert {type(event) for event in EVENTS} == set(get_args(Event))
    found = [event_from_line(line_from_event(event)) for event in EVENTS]
    assert [pair[1] for pair in found if pair is not None] == list(EVENTS)


@pytest.mark.parametrize("line", ["", "{", "[]", '{"event": "later", "time": 1}', '{"event": "warning", "time": 1}'])
def test_other_lines_are_no_events(line: str) -> None:
    assert event_from_line(line) is None


@pytest.mark.skipif(os.name != "posix", reason="Windows keeps files that are open")
def test_reader_follows_the_file_and_notices_another_run(tmp_path: Path) -> None:
    passed: list[Event] = []
    log, reader = EventLog(passed.append), EventReader(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"events\.jsonl"):
        reader.read()
    log(EVENTS[0])
    log.open(tmp_path)
    assert [event for _, event in reader.read()[1]] == [EVENTS[0]]
    log(EVENTS[4])
    with (tmp_path / EVENTS_FILE).open("ab") as stream:
        stream.write(b'{"event": "warning",')
        stream.flush()
        assert [event for _, event in reader.read()[1]] == [EVENTS[4]]
        stream.write(b' "time": 1, "text": "late"}\n')
    assert reader.read() == (False, [(1.0, Warned("late"))])

    second = EventLog(ignore)
    second.open(tmp_path)
    log(EVENTS[-1])  # the first run still writes into its own file
    second(EVENTS[5])
    second(EVENTS[-1])
    is_new, events = reader.read()
    assert is_new
    assert [event for _, event in events] == [EVENTS[5], EVENTS[-1]]
    assert passed == [EVENTS[0], EVENTS[4], EVENTS[-1]]


def test_run_goes_on_without_the_file(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("in the way")
    passed: list[Event] = []
    log = EventLog(passed.append)
    log.open(tmp_path)
    log(EVENTS[0])
    assert isinstance(passed[0], Warned)
    assert passed[1:] == [EVENTS[0]]


def _view(matches: int, candidates: int) -> TwoView:
    matches_idx = np.tile(np.arange(matches, dtype=np.int32)[:, None], (1, 2))
    residuals = np.full(matches, np.deg2rad(0.1), np.float32)
    return TwoView(matches_idx, np.eye(3), np.array([1.0, 0, 0]), residuals, "general", candidates=candidates)


def test_pairs_of_a_later_stage_replace_rejected_ones_and_are_added() -> None:
    matched: dict[tuple[str, ...], dict[str, float]] = {
        ("a", "b"): {"candidates": 80.0, "inliers": 60.0, "residual_deg": 0.05},
        ("b", "c"): {"candidates": 30.0, "inliers": 0.0},
        ("a", "c"): {"candidates": 20.0},
    }
    later: dict[tuple[str, str], TwoView] = {
        ("a", "b"): _view(50, 70),
        ("b", "c"): _view(12, 33),
        ("a", "c"): TwoView.failed("too few"),
        ("c", "d"): _view(9, 15),
    }
    assert pair_links(matched, later) == (
        PairLink("a", "b", 60, 80, 0.05),
        PairLink("b", "c", 12, 33, 0.1),
        PairLink("a", "c", 0, 20, None),
        PairLink("c", "d", 9, 15, 0.1),
    )
    assert pair_links(matched, {})[1] == PairLink("b", "c", 0, 30, None)


SOLVERS = '''
import cv2
import numpy as np
from pano_mvs.api import All, Context, One, Panorama, Poses, Rigid3, stage


def placed(names, rejected):
    cameras = {name: Rigid3.from_center(np.eye(3), np.array([float(idx), 0, 0])) for idx, name in enumerate(names)}
    return Poses.without_points(cameras, rejected=rejected, frame="f", scale="s", metric=False)


@stage("poses.first")
def first(images: All[Panorama], ctx: Context) -> Poses:
    """Place two images."""
    rejected = dict.fromkeys(list(images)[2:], "no place")
    for name, reason in rejected.items():
        ctx.reject(name, reason)
    return placed(list(images)[:2], rejected)


@stage("poses.second")
def second(poses: One[Poses], images: All[Panorama], ctx: Context) -> Poses:
    """Place all images but the last, and repeat why that is left out."""
    left = {name: poses.rejected[name] for name in list(images)[3:]}
    for name, reason in left.items():
        ctx.reject(name, reason)
    return placed(list(images)[:3], left)
'''


def test_an_image_that_a_later_stage_places_is_not_left_out(tmp_path: Path) -> None:
    """A solution from few pairs placed images that the first solver had refused, and the run counted them twice."""
    (tmp_path / "solvers.py").write_text(SOLVERS)
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    for name in "abcd":
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), rng.integers(0, 256, (32, 64, 3)).astype(np.uint8))
    stages = "{images: {use: source.folder, path: images}, poses: {use: poses.first}, again: {use: poses.second}}"
    workflow = tmp_path / "two.yaml"
    workflow.write_text(f"pano_mvs: 1\nname: two\nplugins: [solvers.py]\nstages: {stages}\n")
    run = pano_mvs.run(workflow, out=tmp_path / "out", cache=tmp_path / "cache", executor="serial")
    assert run.summary.poses is not None
    assert list(run.summary.poses.registered) == ["a.png", "b.png", "c.png"]
    assert list(run.summary.poses.rejected) == list(run.summary.rejected) == ["d.png"]
    assert run.summary.exit_code == 3
