"""A plan of many units holds few of them at a time.

One more picture runs its own units and those that it touches, counted.
"""

from __future__ import annotations

import gc
import shutil
from collections import Counter
from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.plan import make_plan
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import open_session
from tests.engine.conftest import Toy, settle
from tools.benchmarks.engine.simulated_capture import write_picture, write_simulated


@pytest.mark.slow
def test_a_plan_takes_units_one_at_a_time(toy: Toy) -> None:
    for number in range(20, 40):
        toy.number(f"{number}.txt", str(number))
    toy.run()
    session = open_session(str(toy.folder / "wf.yaml"), cache=toy.folder / "cache", out=toy.folder / "out")
    alive: dict[str, int] = {}
    visited = Counter[str]()

    def look(unit: Unit, record: UnitRecord | None, reason: str) -> None:
        assert record is not None, reason
        visited[unit.entry.name] += 1
        if visited[unit.entry.name] % 10 != 1:
            return  # counting takes long after other tests
        found = sum(type(value) is Unit for value in gc.get_objects())  # isinstance asks dead proxies for their class
        alive[unit.entry.name] = max(found, alive.get(unit.entry.name, 0))

    make_plan(session.workflow, session.graph, Store(session.store_root), visit=look)
    assert alive["images"] > 20  # a source lists its items at once
    assert alive["difference"] - alive["pairs"] <= 1
    assert alive["mean"] - alive["pairs"] <= 1


COUNT = 24


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_simulated(tmp_path, COUNT)
    return tmp_path


def run(folder: Path) -> dict[str, int]:
    session = open_session(str(folder / "wf.yaml"), cache=folder / "cache", out=folder / "out")
    result = Run(session.workflow, session.graph, Store(session.store_root), out=session.out).execute()
    return {stage.stage: stage.run for stage in result.stages if stage.run}


@pytest.mark.slow
def test_one_more_picture_runs_what_it_touches_and_nothing_else(folder: Path) -> None:
    assert run(folder)["matches"] == 8 * COUNT - 36
    more = write_picture(folder, COUNT)
    settle(Path(shutil.move(more, more.with_name("000012x.png"))))
    assert run(folder) == {
        "images": 1,
        "features": 1,
        "pairs": 1,
        "matches": 16,
        "poses": 1,
        "views": 1,
        "depth": 5,  # its own, and the four whose neighbours it is now among
        "checked": 9,  # those that look at one of the five
        "previews": 5,  # of those, the ones whose ranges are others now
        "cloud": 1,
    }
    assert run(folder) == {}
