"""A toy capture: numbers in text files, doubled, compared in pairs, summed, written. Exercises every cardinality."""

NUMBERS = """
from dataclasses import dataclass
from typing import ClassVar
from pano_mvs.api import (
    All, Axis, Context, Each, FilePart, Files, InputPath, Names, Near, One, Pairs, Params, Record, SourceItem,
    SourcePath, Views, source, stage,
)


class SourceParams(Params):
    path: SourcePath


@dataclass(frozen=True, eq=False)
class Number(Record):
    axis: ClassVar[Axis | None] = Axis.IMAGE
    value: float


def list_items(params):
    for path in sorted(params.path.glob("*.txt")):
        yield SourceItem(path.name, {"text": path})
"""
"""The beginning of a plugin that reads numbers from text files."""

PLUGIN = (
    f'''
"""A toy pipeline."""
import os
import time
from helper import double
{NUMBERS}
'''
    + '''

@dataclass(frozen=True, eq=False)
class Difference(Record):
    axis: ClassVar[Axis | None] = Axis.PAIR
    value: float


@dataclass(frozen=True, eq=False)
class Mean(Record):
    axis: ClassVar[Axis | None] = Axis.VIEW
    value: float


@dataclass(frozen=True, eq=False)
class Shifted(Record):
    """A collection: each number less the mean of all, rounded."""
    explodes_into: ClassVar[type[Record] | None] = Number
    values: dict[str, float]

    def explode(self):
        return {name: Number(value) for name, value in self.values.items()}


@source("toy.source", list_items=list_items)
def read(item: SourceItem, params: SourceParams) -> Number:
    """Read a number."""
    return Number(float(item.files["text"].read_text()))


class ScaleParams(Params):
    by: float = 2.0


@stage("toy.scale")
def scale(x: Each[Number], params: ScaleParams, ctx: Context) -> Number:
    """Multiply."""
    ctx.metric("value", x.value)
    if x.value == 13:
        raise ValueError("thirteen is unlucky")
    return Number(double(x.value) * params.by / 2)


@stage("toy.pairs")
def pairs(names: Names[Number]) -> Pairs:
    """Consecutive pairs."""
    return Pairs(tuple(zip(names, names[1:])))


@stage("toy.difference")
def difference(ends: Near[Number]) -> Difference:
    """Second less first."""
    return Difference(ends[1].value - ends[0].value)


@stage("toy.shifted")
def shifted(xs: All[Number], ctx: Context) -> Shifted:
    """Less the whole part of the mean."""
    mean = sum(x.value for x in xs.values()) // len(xs)
    return Shifted({name: x.value - mean for name, x in xs.items() if x.value >= 0})


@stage("toy.views")
def views(names: Names[Number]) -> Views:
    """Each with those beside it."""
    n = list(names)
    return Views({a: tuple(b for b in n[max(0, i - 1):i + 2] if b != a) for i, a in enumerate(n)})


@stage("toy.mean")
def mean(own: Each[Number], around: Near[Number]) -> Mean:
    """Mean of the neighbours and the own."""
    time.sleep(float(os.environ.get("TOY_SLEEP_S", "0")))
    return Mean((own.value + sum(x.value for x in around)) / (1 + len(around)))


@stage("toy.write_each")
def write_each(mean: Each[Mean], ctx: Context) -> Files:
    """One file each."""
    path = ctx.scratch / "a.txt"
    path.write_text(str(mean.value))
    return Files({"mean/{item}.txt": path})


@stage("toy.write")
def write(differences: All[Difference], shifted: One[Shifted], ctx: Context) -> Files:
    """One file for all."""
    path = ctx.scratch / "all.txt"
    pairs = [(key, d.value) for key, d in differences.items()]
    path.write_text(f"{pairs} {shifted.values} {ctx.rng.random()}")
    return Files({"all.txt": path})
'''
)

HELPER = """
def double(x):
    return 2 * x
"""

WORKFLOW = """\
pano_mvs: 1
name: toy
plugins: [plug.py]
stages:
  images:     {use: toy.source, path: capture}
  scaled:     {use: toy.scale, by: 3}
  pairs:      {use: toy.pairs}
  difference: {use: toy.difference, in: {ends: scaled}}
  shifted:    {use: toy.shifted, in: {xs: scaled}}
  views:      {use: toy.views, in: {names: images}}
  mean:       {use: toy.mean, in: {own: scaled, around: scaled}}
  each:       {use: toy.write_each}
  all:        {use: toy.write}
"""
