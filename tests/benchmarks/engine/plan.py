"""Planning at scale: `python -m tests.benchmarks.engine.plan [ITEMS]`.

A capture of ITEMS small files, features of each, pairs of each with its eight followers, a match of each pair, one
solve of all, a range and a filtered range of each view with four neighbours, and one file for all: at 5,000 items
60,000 units. The stages do next to nothing; what is measured is the plan before anything is cached, the plan and the
run when all is, and the plan after one image is added. The processor time and the peak memory are those of a process
of its own.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.running.run import Run
from pano_mvs.session.planning import without_collector
from pano_mvs.session.session import open_session

ITEMS = 5000
PLUGIN = """
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pano_mvs.api import (All, Axis, Context, Each, Files, Names, Near, One, Pairs, Params, Record, SourceItem,
                          SourcePath, Views, source, stage)




@dataclass(frozen=True)
class Number(Record):
    axis: ClassVar = Axis.IMAGE
    value: float


@dataclass(frozen=True)
class Match(Record):
    axis: ClassVar = Axis.PAIR
    value: float


@dataclass(frozen=True)
class Place(Record):
    axis: ClassVar = Axis.IMAGE
    value: float


@dataclass(frozen=True)
class Places(Record):
    axis: ClassVar = Axis.ONE
    explodes_into: ClassVar = Place
    values: dict

    def explode(self):
        return {name: Place(value) for name, value in self.values.items()}


@dataclass(frozen=True)
class Range(Record):
    axis: ClassVar = Axis.VIEW
    value: float


class SourceParams(Params):
    path: SourcePath


class ScaleParams(Params):
    by: float = 2.0
    a: float = 1.0
    b: float = 1.0
    c: float = 1.0
    d: float = 1.0


def listed(params):
    return [SourceItem(path.name, {"image": path}) for path in sorted(Path(params.path).glob("*.txt"))]


@source("scale.source", list_items=listed)
def read(item: SourceItem, params: SourceParams) -> Number:
    return Number(float(item.files["image"].read_text()))


@stage("scale.features")
def features(x: Each[Number], params: ScaleParams) -> Number:
    return Number(x.value * params.by)


@stage("scale.pairs")
def pairs(names: Names[Number]) -> Pairs:
    n = list(names)
    return Pairs(tuple((a, b) for i, a in enumerate(n) for b in n[i + 1:i + 9]))


@stage("scale.match")
def match(ends: Near[Number], params: ScaleParams) -> Match:
    return Match(ends[1].value - ends[0].value)


@stage("scale.solve")
def solve(xs: All[Match]) -> Places:
    names = sorted({name for pair in xs for name in pair})
    return Places({name: float(name[:5]) for name in names})  # as known poses: one more moves no other


@stage("scale.views")
def views(names: Names[Number]) -> Views:
    n = list(names)
    return Views({a: tuple(b for b in n[max(0, i - 2):i + 3] if b != a) for i, a in enumerate(n)})


@stage("scale.sweep")
def sweep(own: Each[Number], place: Each[Place], around: Near[Number], places: Near[Place],
          params: ScaleParams) -> Range:
    return Range(own.value + sum(x.value for x in around))


@stage("scale.filter")
def filtered(own: Each[Range], around: Near[Range], params: ScaleParams) -> Range:
    return Range(own.value + sum(x.value for x in around))


@stage("scale.write")
def write(xs: All[Range], ctx: Context) -> Files:
    path = ctx.scratch / "all.txt"
    path.write_text(str(sum(x.value for x in xs.values())))
    return Files({"all.txt": path})
"""
WORKFLOW = """\
pano_mvs: 1
name: scale
plugins: [plug.py]
stages:
  images:   {use: scale.source, path: capture}
  features: {use: scale.features, by: 3}
  pairs:    {use: scale.pairs, in: {names: images}}
  matches:  {use: scale.match, in: {ends: features}}
  poses:    {use: scale.solve}
  views:    {use: scale.views, in: {names: images}}
  depth:    {use: scale.sweep, in: {own: images, around: images}}
  smooth:   {use: scale.filter, in: {own: depth, around: depth}}
  cloud:    {use: scale.write, in: {xs: smooth}}
"""


def main() -> None:
    """Make the capture, then measure each step in a process of its own."""
    if sys.argv[1:2] == ["--step"]:
        _measure(sys.argv[2], Path(sys.argv[3]))
        return
    items = int(sys.argv[1]) if len(sys.argv) > 1 else ITEMS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plug.py").write_text(PLUGIN)
        (folder / "wf.yaml").write_text(WORKFLOW)
        (folder / "capture").mkdir()
        for number in range(items):
            (folder / "capture" / f"{number:05d}.txt").write_text(str(number))
        time.sleep(2.5)  # younger files are hashed again each time, since their time stamps cannot be relied on
        print(f"{items} items\n\n| step | units cached / to run | CPU s | wall s | peak MB |\n|---|---|---|---|---|")
        for step in ("plan cold", "run cold", "plan cached", "run cached", "plan one more", "run one more"):
            if step == "plan one more":
                (folder / "capture" / f"{items // 2:05d}x.txt").write_text("12345")
            subprocess.run(
                [sys.executable, "-m", "tests.benchmarks.engine.plan", "--step", step, str(folder)], check=True
            )


def _measure(step: str, folder: Path) -> None:
    session = open_session(str(folder / "wf.yaml"), cache=folder / "cache", out=folder / "out")
    cpu, wall = time.process_time(), time.perf_counter()
    store = Store(session.store_root)
    if step.startswith("plan"):
        with without_collector():
            counts = _count(make_plan(session.workflow, session.graph, store))
        store.stat_cache.save()
    else:
        result = Run(session.workflow, session.graph, store, out=session.out, executor=SerialExecutor(store)).execute()
        counts = f"{sum(s.cached for s in result.stages)} / {sum(s.run for s in result.stages)}"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    print(
        f"| {step} | {counts} | {time.process_time() - cpu:.2f} | {time.perf_counter() - wall:.2f} | {peak:.0f} |",
        flush=True,
    )


def _count(plans: list[StagePlan]) -> str:
    return f"{sum(len(p.cached) for p in plans)} / {sum(len(p.run) for p in plans)}"


if __name__ == "__main__":
    main()
