"""One more picture runs its own units and those that it touches, counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import open_session
from tests.benchmarks.engine.plan import PLUGIN, WORKFLOW
from tests.engine.conftest import settle

COUNT = 60


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plug.py").write_text(PLUGIN)
    (tmp_path / "wf.yaml").write_text(WORKFLOW)
    (tmp_path / "capture").mkdir()
    for number in range(COUNT):
        path = tmp_path / "capture" / f"{number:05d}.txt"
        path.write_text(str(number))
        settle(path)
    return tmp_path


def run(folder: Path) -> dict[str, int]:
    session = open_session(str(folder / "wf.yaml"), cache=folder / "cache", out=folder / "out")
    result = Run(session.workflow, session.graph, Store(session.store_root), out=session.out).execute()
    return {stage.name: stage.run for stage in result.stages if stage.run}


def test_one_more_picture_runs_what_it_touches_and_nothing_else(folder: Path) -> None:
    assert run(folder)["matches"] == 8 * COUNT - 36
    (folder / "capture" / "00030x.txt").write_text("12345")
    assert run(folder) == {
        "images": 1,
        "features": 1,
        "pairs": 1,
        "matches": 16,
        "poses": 1,
        "views": 1,
        "depth": 5,  # its own, and the four whose neighbours it is now among
        "smooth": 9,  # those that look at one of the five
        "cloud": 1,
    }
    assert run(folder) == {}
