"""A capture of four numbers, of which stages make arrays; three of the stages are temporary."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.plan import DEFAULT_OPTIONS, RunOptions, StagePlan, make_plan
from pano_mvs.engine.running.events import RunResult
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import Session, open_session
from tests.engine.conftest import settle

PLUGIN = '''
"""Arrays of numbers, which pass through a chain of stages of one kind."""
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from numpy.typing import NDArray
from pano_mvs.api import (
    All, Axis, Context, Each, Files, Names, Near, One, Params, Record, SourceItem, SourcePath, Views, source, stage,
)


class SourceParams(Params):
    path: SourcePath


@dataclass(frozen=True, eq=False)
class Numbers(Record):
    axis: ClassVar[Axis | None] = Axis.VIEW
    values: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Row(Record):
    """A collection of all."""
    explodes_into: ClassVar[type[Record] | None] = Numbers
    values: NDArray[np.float64]

    def explode(self):
        return {f"{idx}.txt": Numbers(row) for idx, row in enumerate(self.values)}


def list_items(params):
    for path in sorted(params.path.glob("*.txt")):
        yield SourceItem(path.name, {"text": path})


@source("rows.source", list_items=list_items)
def read(item: SourceItem, params: SourceParams) -> Numbers:
    """Read a number."""
    return Numbers(np.arange(100) + float(item.files["text"].read_text()))


class AddParams(Params):
    value: float = 1.0


@stage("rows.add")
def add(x: Each[Numbers], params: AddParams) -> Numbers:
    """Add."""
    return Numbers(x.values + params.value)


@stage("rows.views")
def views(names: Names[Numbers]) -> Views:
    """Each with those beside it."""
    n = list(names)
    return Views({a: tuple(b for b in n[max(0, i - 1):i + 2] if b != a) for i, a in enumerate(n)})


class MeanParams(Params):
    factor: float = 1.0
    fails_at: float = -1.0


@stage("rows.mean")
def mean(own: Each[Numbers], around: Near[Numbers], params: MeanParams) -> Numbers:
    """Mean of the neighbours and the own."""
    if own.values[0] == params.fails_at:
        raise ValueError("as asked")
    return Numbers(params.factor * (own.values + sum(x.values for x in around)) / (1 + len(around)))


@stage("rows.all")
def gather(xs: All[Numbers]) -> Row:
    """All of them."""
    return Row(np.array([x.values for x in xs.values()]))


@stage("rows.write")
def write(x: Each[Numbers], ctx: Context) -> Files:
    """One file each."""
    path = ctx.scratch / "a.txt"
    path.write_text(str(x.values.tolist()))
    return Files({"{item}.txt": path})
'''

WORKFLOW = """\
pano_mvs: 1
name: rows
plugins: [rows.py]
stages:
  images: {use: rows.source, path: capture}
  first:  {use: rows.add, value: 2, temporary: true}
  second: {use: rows.add, value: 3, temporary: true}
  views:  {use: rows.views, in: {names: images}}
  mean:   {use: rows.mean, temporary: true, in: {own: second, around: first}}
  last:   {use: rows.add, value: 5}
  files:  {use: rows.write}
"""
TEMPORARY = ("first", "second", "mean")
KEPT = {"images", "views", "last", "files"}  # the stages whose results stay


class Rows:
    """A capture of four numbers in a folder, with shortcuts to run it."""

    def __init__(self, folder: Path, workflow: str = WORKFLOW) -> None:
        self.folder = folder
        (folder / "capture").mkdir()
        for idx, number in enumerate((0, 11, 43, 101)):
            path = folder / "capture" / f"{idx}.txt"
            path.write_text(str(number))
            settle(path)
        (folder / "rows.py").write_text(PLUGIN)
        (folder / "wf.yaml").write_text(workflow)

    @property
    def store(self) -> Store:
        return Store(self.folder / "cache")

    def session(self, *overrides: str, out: str = "out") -> Session:
        return open_session(
            str(self.folder / "wf.yaml"), overrides=overrides, cache=self.folder / "cache", out=self.folder / out
        )

    def run(self, *overrides: str, options: RunOptions = DEFAULT_OPTIONS, out: str = "out") -> RunResult:
        session = self.session(*overrides, out=out)
        return Run(session.workflow, session.graph, self.store, out=session.out, options=options).execute()

    def plan(self, *overrides: str, options: RunOptions = DEFAULT_OPTIONS) -> Mapping[str, StagePlan]:
        session = self.session(*overrides)
        workflow, graph = options.applied_to(session.workflow, session.graph)
        return {plan.name: plan for plan in make_plan(workflow, graph, self.store, options=options)}

    def records(self, stage: str, out: str = "out") -> list[UnitRecord]:
        store, own = self.store, str((self.folder / out).resolve())
        entry = next(entry for entry in store.runs.entries() if entry.out == own and not entry.pinned)
        found = [store.read_record(key) for key in entry.keys[stage].values()]
        return [record for record in found if record is not None]

    def has(self, stage: str, out: str = "out") -> bool:
        """Whether the cache has all results of a stage; an error if it has some of them."""
        store = self.store
        found = {all(map(store.blobs.exists, record.blobs())) for record in self.records(stage, out)}
        assert len(found) == 1
        return found == {True}

    def kept(self, *, of: str = "out") -> set[str]:
        """The stages whose results the cache has."""
        return {stage for stage in ("images", *TEMPORARY, "views", "last", "files") if self.has(stage, of)}

    def files(self, out: str = "out") -> dict[str, str]:
        return {path.name: path.read_text() for path in sorted((self.folder / out).glob("?.txt"))}
