"""A plan of many units holds few of them at a time."""

from __future__ import annotations

import gc
from collections import Counter

import pytest

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.plan import make_plan
from pano_mvs.engine.planning.units import Unit
from pano_mvs.session.session import open_session
from tests.engine.conftest import Toy


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
