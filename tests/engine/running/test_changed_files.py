"""Files of a capture that change or vanish while a run goes on: they cost their item, and nothing wrong is stored."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.running.events import Observer, RunEvent, RunResult, UnitFinished, Warned
from pano_mvs.engine.running.run import Run
from tests.engine.conftest import Toy, settle
from tests.engine.toy import NUMBERS

PLUGIN = (
    NUMBERS
    + '''
@dataclass(frozen=True, eq=False)
class Text(Record):
    """A text, by reference to its file."""
    axis: ClassVar[Axis | None] = Axis.IMAGE
    file: FilePart


@dataclass(frozen=True, eq=False)
class Total(Record):
    value: float


@source("toy.source", list_items=list_items)
def read(item: SourceItem, params: SourceParams) -> Text:
    """Refer to a file."""
    return Text(item.file("text"))


@stage("toy.first")
def first(text: Each[Text]) -> Number:
    """The number in a text."""
    return Number(float(text.file.read_bytes()))


@stage("toy.total")
def total(texts: All[Text], numbers: All[Number]) -> Total:
    """Sum of the numbers, and of what the files say."""
    return Total(sum(n.value for n in numbers.values()) + sum(float(t.file.read_bytes()) for t in texts.values()))


@stage("toy.late")
def late(text: Each[Text], total: One[Total]) -> Number:
    """Read the file once more, as plugins may do that know nothing of checks."""
    return Number(float(text.file.path.read_text()) + total.value)


@stage("toy.write")
def write(number: Each[Number], ctx: Context) -> Files:
    path = ctx.scratch / "a.txt"
    path.write_text(str(number.value))
    return Files({"{item}.out": path})


class AddParams(Params):
    file: InputPath


@stage("toy.add")
def add(total: One[Total], params: AddParams) -> Total:
    """Add what a file of the settings says."""
    return Total(total.value + float(params.file.read_text()))
'''
)

WORKFLOW = """\
pano_mvs: 1
name: toy
plugins: [plug.py]
stages:
  images: {use: toy.source, path: capture}
  first:  {use: toy.first}
  total:  {use: toy.total}
  late:   {use: toy.late}
  write:  {use: toy.write, in: {number: late}}
"""


@pytest.fixture
def texts(toy: Toy) -> Toy:
    (toy.folder / "plug.py").write_text(PLUGIN)
    (toy.folder / "wf.yaml").write_text(WORKFLOW)
    return toy


class Meddler:
    """Does something once, when a unit has been computed."""

    def __init__(self, stage: str, item: str, meddle: Callable[[], object]) -> None:
        self._when = stage, item
        self._meddle: Callable[[], object] | None = meddle
        self.warnings: list[str] = []

    def __call__(self, event: RunEvent | None) -> None:
        if isinstance(event, UnitFinished) and (event.stage, event.item) == self._when and self._meddle is not None:
            self._meddle()
            self._meddle = None
        elif isinstance(event, Warned):
            self.warnings.append(event.text)


def run(toy: Toy, observer: Observer | None = None, *, executor: str = "serial", cache: str = "cache") -> RunResult:
    session = toy.session(cache=toy.folder / cache)
    store = Store(session.store_root)
    made: Executor
    made = SerialExecutor(store, threads=1) if executor == "serial" else ProcessExecutor(store, workers=1, threads=1)
    try:
        return Run(session.workflow, session.graph, store, out=session.out, observer=observer, executor=made).execute()
    finally:
        made.close()


def without(toy: Toy, name: str) -> dict[str, bytes]:
    """Return what a run of a capture delivers that never had a file."""
    path = toy.folder / "capture" / name
    aside = path.read_bytes() if path.exists() else None
    path.unlink(missing_ok=True)
    session = toy.session(cache=toy.folder / "elsewhere")
    out = toy.folder / "clean"
    assert Run(session.workflow, session.graph, Store(session.store_root), out=out).execute().exit_code == 0
    if aside is not None:
        path.write_bytes(aside)
    return {path.name: path.read_bytes() for path in out.glob("*.out")}


def delivered(toy: Toy) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (toy.folder / "out").glob("*.out")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after", "executor"),
    [
        (("first", "2.txt"), "serial"),
        (("total", ""), "serial"),
        (("late", "1.txt"), "serial"),
        (("total", ""), "processes"),
    ],
)
def test_image_that_changes_costs_that_image(texts: Toy, executor: str, after: tuple[str, str]) -> None:
    path = texts.folder / "capture" / "2.txt"
    result = run(texts, Meddler(*after, lambda: path.write_text("77")), executor=executor)
    assert result.exit_code == 3
    assert [(failure.stage, failure.item) for failure in result.failures] == [("images", "2.txt")]
    assert "2.txt changed during the run; run again" in result.failures[0].cause
    assert delivered(texts) == without(texts, "2.txt")
    again = run(texts, executor=executor)
    assert again.exit_code == 0
    assert (texts.folder / "out" / "2.out").read_text() == str(77.0 + 2 * (10 + 77 + 30 + 40 + 50))


def test_image_that_is_put_back_finds_nothing_wrong_in_the_cache(texts: Toy) -> None:
    """Features of the old bytes and ranges of the new ones lay in the cache, under the digest of the old ones."""
    clean = run(texts, cache="clean_cache")
    assert clean.exit_code == 0
    expected = delivered(texts)
    path = texts.folder / "capture" / "2.txt"
    run(texts, Meddler("first", "5.txt", lambda: path.write_text("77")))
    path.write_text("20")
    settle(path)
    assert run(texts).exit_code == 0
    assert delivered(texts) == expected


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["serial", "processes"])
def test_image_that_vanishes_costs_that_image(texts: Toy, executor: str) -> None:
    """The run stopped with exit code 2."""
    path = texts.folder / "capture" / "3.txt"
    result = run(texts, Meddler("total", "", path.unlink), executor=executor)
    assert result.exit_code == 3
    assert [failure.item for failure in result.failures] == ["3.txt"]
    assert delivered(texts) == without(texts, "3.txt")


def test_image_that_is_touched_is_the_same(texts: Toy) -> None:
    path = texts.folder / "capture" / "3.txt"
    assert run(texts, Meddler("total", "", lambda: os.utime(path))).exit_code == 0


def test_many_that_change_take_one_more_pass(texts: Toy) -> None:
    meddler = Meddler("total", "", lambda: [(texts.folder / "capture" / f"{n}.txt").write_text("9") for n in (1, 2, 3)])
    result = run(texts, meddler)
    assert [failure.item for failure in result.failures] == ["1.txt", "2.txt", "3.txt"]
    assert len(meddler.warnings) == 3
    assert len(delivered(texts)) == 2


def test_what_was_delivered_before_the_change_is_not_of_the_result(texts: Toy) -> None:
    texts.edit("wf.yaml", lambda text: text + "  again:  {use: toy.total, in: {numbers: late}}\n")
    path = texts.folder / "capture" / "2.txt"
    result = run(texts, Meddler("write", "5.txt", lambda: path.write_text("77")))
    assert result.exit_code == 3
    assert sorted(result.published) == ["1.out", "3.out", "4.out", "5.out"]
    assert list(result.left_over) == ["2.out"]


def test_image_that_changes_before_it_is_read_fails(texts: Toy) -> None:
    result = run(texts, Meddler("images", "1.txt", lambda: (texts.folder / "capture" / "4.txt").write_text("4")))
    assert result.exit_code == 3
    assert [failure.item for failure in result.failures] == ["4.txt"]
    assert delivered(texts) == without(texts, "4.txt")


def test_image_that_appears_during_the_run_waits_for_the_next(texts: Toy) -> None:
    """A run that starts over lists nothing anew: its results would belong to no state of the capture."""

    def meddle() -> None:
        (texts.folder / "capture" / "2.txt").unlink()
        texts.number("6.txt", "60")

    result = run(texts, Meddler("total", "", meddle))
    assert result.exit_code == 3
    assert sorted(delivered(texts)) == ["1.out", "3.out", "4.out", "5.out"]
    assert run(texts).exit_code == 0
    assert (texts.folder / "out" / "6.out").exists()


@pytest.mark.parametrize("change", ["change", "vanish"])
def test_file_of_the_settings_that_changes_fails_what_reads_it(texts: Toy, change: str) -> None:
    """Truth, known poses: the unit that reads them is not stored under the digest of what they were."""
    path: Path = texts.folder / "truth.txt"
    path.write_text("1000")
    settle(path)
    texts.edit(
        "plug.py",
        lambda text: text.replace(
            "    return Total(total.value + float(params.file.read_text()))",
            "    import pathlib, os\n    p = pathlib.Path(__file__).with_name('meddle')\n"
            "    if p.exists():\n        p.unlink()\n        "
            + ("params.file.write_text('5')" if change == "change" else "params.file.unlink()")
            + "\n    return Total(total.value + float(params.file.read_text()))",
        ),
    )
    texts.edit("wf.yaml", lambda text: text.replace("  late:", "  add:    {use: toy.add, file: truth.txt}\n  late:"))
    (texts.folder / "meddle").touch()
    result = run(texts)
    assert result.exit_code == 3
    assert [(failure.stage, failure.item) for failure in result.failures] == [("add", "")]
    assert "truth.txt " in result.failures[0].cause
    assert "during the run" in result.failures[0].cause
    path.write_text("1000")
    assert run(texts).exit_code == 0
    assert (texts.folder / "out" / "2.out").read_text() == str(20.0 + 300 + 1000)
