"""One pass of a run: how units are settled, and what is counted, doubted and measured."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError, PanoMvsError, RunStoppedError, StoreError, UsageError
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.planning.units import PENDING, StageState, Unit
from pano_mvs.engine.running import run as run_module
from pano_mvs.engine.running.dispatcher import FinishedJob
from pano_mvs.engine.running.events import Observer, RunEvent, RunResult, UnitFailed, UnitFinished, UnitStarted
from pano_mvs.engine.running.events import ignore as ignore_event
from pano_mvs.engine.running.run import Run, RunPass, UnusableInputError
from pano_mvs.engine.running.statistics import PackedFigures, RunStatistics
from pano_mvs.scene import Axis
from tests.engine.conftest import Toy, ran, settle


class Shelf(SerialExecutor):
    """Takes several jobs, and computes them one by one, or answers as it is told to.

    Attributes:
        latest_first: whether the job that was taken last is computed first.
        memory_bytes: what is said to be free; 0 for not known.
        answers: unit to what comes back in place of its result.
        submitted: the units that it was given, in order.
        most: how many it had at a time.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store, threads=1)
        self.capacity = 4
        self.latest_first = True
        self.memory_bytes = 0
        self.answers: dict[str, JobOutcome] = {}
        self.submitted: list[str] = []
        self.most = 0

    def submit(self, job: Job) -> None:
        super().submit(job)
        self.submitted.append(job.unit.label)
        self.most = max(self.most, len(self._jobs))

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if self.latest_first:
            self._jobs[:] = self._jobs[-1:] + self._jobs[:-1]
        if timeout_s != 0 and self._jobs and self._jobs[0].unit.label in self.answers:
            job = self._jobs.pop(0)
            return job.number, self.answers[job.unit.label]
        return super().wait(timeout_s)

    def free_memory_bytes(self) -> int:
        return self.memory_bytes


class Heard:
    """Notes what it hears of units."""

    def __init__(self) -> None:
        self.started: list[str] = []
        self.finished: list[tuple[str, str]] = []

    def __call__(self, event: RunEvent | None) -> None:
        if isinstance(event, UnitStarted):
            self.started.append(f"{event.stage}:{event.item}")
        elif isinstance(event, UnitFinished):
            self.finished.append((f"{event.stage}:{event.item}", event.outcome))


def run_with(toy: Toy, shelf: Shelf, *overrides: str, observer: Observer | None = None) -> RunResult:
    session = toy.session(*overrides)
    store = Store(session.store_root)
    return Run(session.workflow, session.graph, store, out=session.out, observer=observer, executor=shelf).execute()


@pytest.fixture
def shelf(tmp_path: Path) -> Shelf:
    """Records of the toy's store."""
    return Shelf(Store(tmp_path / "cache"))


def summary(result: RunResult) -> Mapping[str, tuple[int, int, int, int]]:
    return {one.stage: (one.run, one.cached, one.failed, one.blocked) for one in result.stages}


def test_as_many_units_are_out_as_the_executor_takes_and_the_result_is_that_of_one(toy: Toy, shelf: Shelf) -> None:
    shelf.capacity = 3
    result = run_with(toy, shelf)
    assert shelf.most == 3
    assert result.exit_code == 0
    files = toy.deliverables()
    shutil.rmtree(toy.folder / "cache")
    again = toy.run()
    assert toy.deliverables() == files
    assert (again.published, summary(again)) == (result.published, summary(result))
    assert len(shelf.submitted) == len(set(shelf.submitted)) == sum(ran(result).values())


def test_what_is_in_the_store_is_not_handed_out(finished: Toy, shelf: Shelf) -> None:
    heard = Heard()
    result = run_with(finished, shelf, observer=heard)
    assert shelf.submitted == heard.started == []
    assert all(counts[0] == 0 and counts[1] > 0 for counts in summary(result).values())
    assert {status for _, status in heard.finished} == {"cached"}


def test_units_of_one_key_are_computed_once(toy: Toy, shelf: Shelf) -> None:
    for name in ("0.txt", "6.txt"):
        toy.number(name, "10")  # as 1.txt has
    result = run_with(toy, shelf)
    assert result.exit_code == 0
    scaled = [label for label in shelf.submitted if label.startswith("scaled:")]
    assert len([label for label in scaled if label in {"scaled:0.txt", "scaled:1.txt", "scaled:6.txt"}]) == 1
    assert summary(result)["scaled"] == (7, 0, 0, 0)


def test_where_a_unit_fails_those_of_its_key_fail_with_it(toy: Toy, shelf: Shelf) -> None:
    for name in ("2.txt", "4.txt"):
        toy.number(name, "13")
    shelf.latest_first = False
    result = run_with(toy, shelf)
    failed = [one for one in result.failures if one.stage == "scaled"]
    assert [one.item for one in failed] == ["2.txt", "4.txt"]
    assert all("thirteen is unlucky" in one.cause for one in failed)
    assert len([label for label in shelf.submitted if label.startswith("scaled:")]) == 4
    assert summary(result)["scaled"] == (3, 0, 2, 0)


@pytest.mark.parametrize(
    ("name", "error"),
    [("StoreError", StoreError), ("UsageError", UsageError), ("ElseError", PanoMvsError)],
)
def test_what_stops_the_run_is_raised_as_what_it_is(
    toy: Toy, shelf: Shelf, name: str, error: type[PanoMvsError]
) -> None:
    shelf.answers["scaled:4.txt"] = JobOutcome("stopped", cause="nothing can go on", error=name)
    with pytest.raises(error, match="nothing can go on") as caught:
        run_with(toy, shelf)
    assert type(caught.value) is error
    assert not shelf._jobs


def test_a_unit_that_fails_costs_what_needs_it_and_is_listed_with_its_reason(toy: Toy, shelf: Shelf) -> None:
    shelf.answers["scaled:3.txt"] = JobOutcome("failed", cause="too dark", trace="line 1", seconds=2.0)
    result = run_with(toy, shelf)
    assert result.exit_code == 3
    failure = next(one for one in result.failures if one.stage == "scaled")
    assert (failure.item, failure.cause, failure.trace, failure.log, failure.said) == (
        "3.txt",
        "too dark",
        "line 1",
        "",
        (),
    )
    assert "scaled" in failure.consequence or "3.txt" in failure.consequence
    assert summary(result)["scaled"] == (4, 0, 1, 0)
    assert "mean/3.txt" not in result.published
    assert "mean/1.txt" in result.published


def test_bad_input_to_a_stage_on_which_all_wait_ends_the_run_with_its_code(toy: Toy, shelf: Shelf) -> None:
    shelf.answers["pairs"] = JobOutcome("failed", cause="no such file", exit_code=InputError.exit_code)
    result = run_with(toy, shelf)
    assert (result.exit_code, result.stopped) == (InputError.exit_code, "pairs: no such file")


def test_bad_input_to_one_of_many_units_costs_that_unit(toy: Toy, shelf: Shelf) -> None:
    shelf.answers["scaled:3.txt"] = JobOutcome("failed", cause="no such file", exit_code=InputError.exit_code)
    assert run_with(toy, shelf).exit_code == 3


def test_a_failure_of_a_stage_on_which_all_wait_is_a_failure_like_others(toy: Toy, shelf: Shelf) -> None:
    shelf.answers["pairs"] = JobOutcome("failed", cause="a mistake in the code")
    result = run_with(toy, shelf)
    assert (result.exit_code, result.stopped) == (3, "")


def test_a_stop_carries_its_code() -> None:
    assert UnusableInputError("why", 5).exit_code == 5
    assert str(UnusableInputError("why", 5)) == "why"
    assert isinstance(UnusableInputError("why", 5), RunStoppedError)


def test_a_unit_that_needs_more_memory_than_there_is_fails_and_the_others_go_on(toy: Toy, shelf: Shelf) -> None:
    shelf.memory_bytes = 3_000_000
    result = run_with(toy, shelf, "scaled.memory=2MB", "pairs.memory=5MB")
    (failure,) = result.failures
    assert failure.stage == "pairs"
    assert "it declares 5" in failure.cause
    assert summary(result)["scaled"] == (5, 0, 0, 0)
    assert summary(result)["pairs"] == (0, 0, 1, 0)
    assert "pairs" not in shelf.submitted


@pytest.mark.parametrize("memory", ["1MB", "5MB"])
def test_whatever_is_computed_or_refused_is_heard_of_as_begun_and_ended(toy: Toy, shelf: Shelf, memory: str) -> None:
    shelf.memory_bytes = 3_000_000
    heard = Heard()
    run_with(toy, shelf, f"pairs.memory={memory}", observer=heard)
    assert [name for name in heard.started if name.startswith("pairs")] == ["pairs:"]
    assert [one for one in heard.finished if one[0] == "pairs:"] == [("pairs:", "run" if memory == "1MB" else "failed")]
    blocked = {name for name, status in heard.finished if status == "blocked"}
    assert sorted(heard.started) == sorted(name for name, _ in heard.finished if name not in blocked)


def test_units_wait_for_memory_and_nothing_overtakes_them(
    toy: Toy, shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    shelf.memory_bytes = 3_000_000
    shelf.latest_first = False
    together: list[int] = []
    submit = shelf.submit

    def counted(job: Job) -> None:
        submit(job)
        together.append(len([one for one in shelf._jobs if one.unit.entry.name == "scaled"]))

    monkeypatch.setattr(shelf, "submit", counted)
    assert run_with(toy, shelf, "scaled.memory=2MB").exit_code == 0
    assert max(together) == 1
    assert [one for one in shelf.submitted if one.startswith("scaled")] == [f"scaled:{n}.txt" for n in range(1, 6)]


def test_results_of_units_that_were_out_when_a_pass_ended_count_as_computed(finished: Toy, shelf: Shelf) -> None:
    store = finished.folder / "cache"
    for blob in (store / "blobs").rglob("*.json"):
        blob.write_bytes(b"x" * blob.stat().st_size)
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 4"))
    result = run_with(finished, shelf)
    assert result.exit_code == 0
    assert result.warnings
    assert summary(result)["scaled"] == (5, 0, 0, 0)
    assert finished.run().computed == 0


def test_a_damaged_record_is_reported_with_its_path_and_computed_again(finished: Toy, shelf: Shelf) -> None:
    key = next(iter((finished.folder / "cache" / "records").rglob("*.json")))
    key.write_bytes(b"nothing")
    result = run_with(finished, shelf)
    assert result.warnings == [f"{key} is damaged; computing it again"]
    assert len(shelf.submitted) == 1


def test_units_that_deliver_one_file_end_the_run(toy: Toy, shelf: Shelf) -> None:
    toy.edit("plug.py", lambda text: text.replace("mean/{item}.txt", "mean/fixed.txt"))
    with pytest.raises(UsageError, match=r"stage 'each' delivers mean/fixed\.txt for"):
        run_with(toy, shelf)


def test_a_damaged_input_is_left_for_the_next_pass(toy: Toy, shelf: Shelf, monkeypatch: pytest.MonkeyPatch) -> None:
    shelf.answers["scaled:4.txt"] = JobOutcome("damaged", cause="a blob is damaged")
    wait = shelf.wait

    def once(timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        found = wait(timeout_s)
        if found is not None and found[1].status == "damaged":
            shelf.answers.clear()
        return found

    monkeypatch.setattr(shelf, "wait", once)
    result = run_with(toy, shelf)
    assert (result.exit_code, result.warnings) == (0, ["a blob is damaged"])
    assert summary(result)["scaled"] == (5, 0, 0, 0)  # what the first pass computed does not count as found
    assert shelf.submitted.count("scaled:4.txt") == 2
    assert shelf.submitted.count("scaled:5.txt") == 1


def test_a_file_whose_stored_bytes_are_damaged_is_computed_and_delivered_again(finished: Toy, shelf: Shelf) -> None:
    files = finished.deliverables()
    shutil.rmtree(finished.folder / "out")
    damaged = sorted((finished.folder / "cache" / "blobs").rglob("*.txt"))
    for blob in damaged:
        blob.write_bytes(b"x" * blob.stat().st_size)
    result = run_with(finished, shelf)
    assert result.exit_code == 0
    assert finished.deliverables() == files
    assert len(result.warnings) == len(damaged)
    assert {name: counts[0] for name, counts in summary(result).items() if counts[0]} == {"each": 5, "all": 1}


def test_an_image_that_changed_is_left_out_and_the_run_goes_over_its_stages_again(toy: Toy, shelf: Shelf) -> None:
    path = toy.folder / "capture" / "3.txt"
    reason = f"{path} changed during the run"
    shelf.answers["scaled:3.txt"] = JobOutcome("changed", cause=reason, changed={str(path): reason})
    result = run_with(toy, shelf)
    assert result.exit_code == 3
    assert result.warnings == [reason]
    failed = [(one.stage, one.item, one.cause) for one in result.failures]
    assert failed == [("images", "3.txt", reason)]
    assert "mean/3.txt" not in result.published
    assert "mean/2.txt" in result.published


def test_a_change_of_a_file_that_no_source_listed_is_a_failure_of_the_unit(toy: Toy, shelf: Shelf) -> None:
    path, reason = str(toy.folder / "settings.csv"), "settings.csv changed during the run"
    shelf.answers["scaled:3.txt"] = JobOutcome("changed", cause=reason, changed={path: reason})
    result = run_with(toy, shelf)
    assert (result.exit_code, result.warnings) == (3, [])
    assert [(one.stage, one.item, one.cause) for one in result.failures] == [("scaled", "3.txt", reason)]


def test_results_that_come_after_the_end_of_a_pass_count_as_computed(
    toy: Toy, shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = toy.session()
    run = Run(session.workflow, session.graph, Store(session.store_root), out=session.out, executor=shelf)
    run.computed["z"] = "scaled"
    record, entry = UnitRecord("a", {}, ItemRef("K", "d" * 32, {})), session.workflow.stages["scaled"]
    outcomes = {"a": JobOutcome("done", record), "b": JobOutcome("failed"), "c": JobOutcome("done", record)}
    ended = [FinishedJob(Unit(entry, key, (), {}, key, {}), outcome) for key, outcome in outcomes.items()]
    monkeypatch.setattr(run.dispatcher, "next_finished", lambda: ended.pop(0) if ended else None)
    RunPass(run, []).drain()
    assert run.computed == dict.fromkeys("zac", "scaled")


GUESSES = '''

@dataclass(frozen=True, eq=False)
class Guess(Record):
    """A collection that doubts some of its items."""
    doubts: dict[str, str]

    def doubted(self):
        return self.doubts


class GuessParams(Params):
    doubts: dict[str, str] = {}


@stage("toy.guess")
def guess(xs: All[Number], params: GuessParams) -> Guess:
    """Doubt what the settings say."""
    return Guess(params.doubts)


@stage("toy.guess_again")
def guess_again(guess: One[Guess], params: GuessParams) -> Guess:
    """Doubt what the settings say."""
    return Guess(params.doubts)


class GuessAllParams(GuessParams):
    left_out: dict[str, str] = {}


@stage("toy.guess_all")
def guess_all(xs: All[Number], params: GuessAllParams, ctx: Context) -> Guess:
    """Doubt and leave out what the settings say."""
    for name, why in params.left_out.items():
        ctx.reject(name, why)
    return Guess(params.doubts)


@stage("toy.by_guess")
def by_guess(x: Each[Number], guess: One[Guess]) -> Number:
    """Return the number."""
    return x


@stage("toy.count_doubts")
def count_doubts(guess: One[Guess], ctx: Context) -> Files:
    """Write the number of doubts."""
    path = ctx.scratch / "count.txt"
    path.write_text(str(len(guess.doubts)))
    return Files({"count.txt": path})
'''

WORKFLOW = """\
pano_mvs: 1
name: guesses
plugins: [plug.py]
stages:
  images: {use: toy.source, path: capture}
  first:  {use: toy.guess}
  second: {use: toy.guess_again}
  count:  {use: toy.count_doubts}
"""


@pytest.fixture
def guesses(toy: Toy) -> Toy:
    for name, text in (("plug.py", (toy.folder / "plug.py").read_text() + GUESSES), ("wf.yaml", WORKFLOW)):
        (toy.folder / name).write_text(text)
        settle(toy.folder / name)
    return toy


def test_a_doubt_ends_with_code_3_and_a_cached_run_says_it_again(guesses: Toy) -> None:
    doubt = "second.doubts={2.txt: odd}"
    for computed in (8, 0):
        result = guesses.run(doubt)
        assert (result.computed, result.exit_code, result.stopped) == (computed, 3, "")
        assert result.doubts == {"2.txt": ("second", "odd")}
        assert not result.failures


def test_the_last_value_of_a_kind_decides(guesses: Toy) -> None:
    first = "first.doubts={2.txt: odd, 3.txt: dark}"
    passed_on = guesses.run(first, "second.doubts={2.txt: odd}")
    assert passed_on.doubts == {"2.txt": ("second", "odd")}
    cleared = guesses.run(first)
    assert (cleared.exit_code, cleared.doubts) == (0, {})


def test_a_doubt_of_a_value_that_nothing_replaces_counts_whatever_else_reads_it(guesses: Toy) -> None:
    (guesses.folder / "wf.yaml").write_text(WORKFLOW.replace("  second: {use: toy.guess_again}\n", ""))
    result = guesses.run("first.doubts={2.txt: odd}")
    assert (result.exit_code, result.doubts) == (3, {"2.txt": ("first", "odd")})


SOLVED_TWICE = """\
  used:   {use: toy.by_guess}
  again:  {use: toy.guess_all, in: {xs: used}, left_out: {3.txt: late}}
"""


def test_what_a_value_that_only_led_to_another_says_does_not_count(guesses: Toy) -> None:
    """Images that SIFT alone does not place were reported, though learned matches placed them."""
    first = "  first:  {use: toy.guess_all, doubts: {2.txt: odd}, left_out: {1.txt: blurred}}\n"
    head = WORKFLOW[: WORKFLOW.index("  first:")]
    (guesses.folder / "wf.yaml").write_text(head + first)
    alone = guesses.run()
    assert (alone.doubts, alone.rejected) == ({"2.txt": ("first", "odd")}, {"1.txt": ("first", "blurred")})
    (guesses.folder / "wf.yaml").write_text(head + first + SOLVED_TWICE)
    both = guesses.run()
    assert (both.exit_code, both.doubts, both.rejected) == (3, {}, {"3.txt": ("again", "late")})


def test_a_stage_that_does_what_another_did_is_cached(guesses: Toy) -> None:
    """The poses counted as computed twice where learned matches added nothing."""
    (guesses.folder / "wf.yaml").write_text(WORKFLOW.partition("  count:")[0].replace("toy.guess_again", "toy.guess"))
    states = {stage.stage: (stage.run, stage.cached) for stage in guesses.run().stages}
    assert (states["first"], states["second"]) == ((1, 0), (0, 1))


def test_files_of_an_earlier_run_go_though_something_is_doubtful(guesses: Toy) -> None:
    earlier = dict(guesses.run("count.to=here").published)
    result = guesses.run("count.to=there", "second.doubts={2.txt: odd}", earlier=earlier)
    assert (result.exit_code, result.removed) == (3, ["here/count.txt"])


def test_a_stage_takes_the_time_in_which_its_units_are_computed(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage whose first unit came early and whose last one came late took hours, most of which it waited."""
    now = [0.0]
    monkeypatch.setattr("pano_mvs.engine.running.statistics.time.perf_counter", lambda: now[0])
    entry = toy.session().workflow.stages["scaled"]
    state = StageState(Axis.IMAGE, pending=set("abcd"))

    def ignore(_names: Iterable[str]) -> None:
        pass

    result = RunResult()
    counts = RunStatistics(result, ignore_event, states=lambda _name: state, name_items=ignore)
    counts.stage_opened(entry)

    def at(time_s: float) -> None:
        now[0] = time_s

    record = UnitRecord("k", {}, PENDING, seconds=3.0)
    at(100.0)
    counts.unit_started(entry, "a")
    at(101.0)
    counts.unit_started(entry, "b")
    at(103.0)
    counts.unit_done(entry, "a", record, status="run")
    counts.unit_done(entry, "c", record, status="cached")
    at(104.0)
    counts.unit_done(entry, "b", record, status="run")
    at(200.0)
    counts.unit_started(entry, "d")
    at(202.0)
    counts.unit_failed(UnitFailed("scaled", "d", "why"), 2.0)
    at(500.0)
    counts.stage_complete(entry)
    (summary,) = result.stages
    assert summary.seconds == 4.0 + 2.0
    assert (summary.unit_seconds, summary.slowest_s, summary.run) == (6.0, 3.0, 2)


class Patient(SerialExecutor):
    """Reports that nothing has ended yet, each time before it computes a unit."""

    def __init__(self, store: Store) -> None:
        super().__init__(store, threads=1)
        self.waits: list[float | None] = []

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if timeout_s == 0:
            return None
        self.waits.append(timeout_s)
        return super().wait(timeout_s) if len(self.waits) % 2 == 0 else None


class Waiting:
    """Counts how often it learns that a run waits."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, event: RunEvent | None) -> None:
        self.count += event is None


def test_an_observer_learns_that_a_run_waits_and_the_run_goes_on(toy: Toy) -> None:
    session, observer = toy.session(), Waiting()
    store = Store(session.store_root)
    executor = Patient(store)
    run = Run(session.workflow, session.graph, store, out=session.out, observer=observer, executor=executor)
    assert run.execute().exit_code == 0
    assert observer.count == len(executor.waits) / 2 > 20
    assert set(executor.waits) == {run_module.WAIT_S}


FIGURES = {"inliers": 213.0, "residual_deg": 0.1 + 0.2, "least": -0.0, "large": 1e300}


@pytest.mark.parametrize("names", [[], ["large"], list(FIGURES), list(reversed(FIGURES))])
def test_packed_figures_equal_a_dict_of_the_same(names: list[str]) -> None:
    figures = {name: FIGURES[name] for name in names}
    packed = PackedFigures(figures)
    assert list(packed.items()) == list(figures.items())
    assert packed == figures
    assert packed == PackedFigures(figures)
    assert len(packed) == len(figures)
    assert repr(packed) == repr(figures)


def test_packed_figures_differ_in_any_name_and_figure() -> None:
    packed = PackedFigures(FIGURES)
    assert packed != PackedFigures(FIGURES | {"inliers": 214.0})
    assert packed != PackedFigures({name: FIGURES[name] for name in ("inliers", "large")})
    assert "outliers" not in packed
    with pytest.raises(KeyError, match="outliers"):
        packed["outliers"]
