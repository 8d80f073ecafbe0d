from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors import execute
from pano_mvs.engine.planning.plan import RunOptions, make_plan
from pano_mvs.engine.running.events import RunResult
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages import stage_code
from pano_mvs.engine.stages.context import Context
from tests.engine.conftest import Toy, ran


def run(toy: Toy, options: RunOptions) -> RunResult:
    session = toy.session()
    return Run(session.workflow, session.graph, Store(session.store_root), out=session.out, options=options).execute()


def test_until_runs_only_what_the_stage_needs(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(until=("difference",)))) == {"images": 5, "scaled": 5, "pairs": 1, "difference": 4}
    assert ran(toy.run()).keys() == {"shifted", "views", "mean", "each", "all"}


def test_only_runs_one_unit_and_what_it_needs(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(only=("mean:2.txt",)))) == {"images": 5, "scaled": 5, "views": 1, "mean": 1}
    assert ran(run(toy, RunOptions(only=("mean:2.txt", "mean:3.txt")))) == {"mean": 1}


def test_only_of_a_stage_beside_one_of_its_units_runs_the_stage(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(only=("scaled", "scaled:2.txt")))) == {"images": 5, "scaled": 5}


def test_part_of_a_run_deletes_no_file_of_the_whole(toy: Toy) -> None:
    earlier = toy.run().published
    files = toy.deliverables()
    session = toy.session()
    options = RunOptions(until=("scaled",))
    result = Run(session.workflow, session.graph, Store(session.store_root), out=session.out, options=options).execute(
        earlier_files=earlier
    )
    assert not result.removed
    assert toy.deliverables() == files


def test_refresh_computes_again_and_what_turns_out_the_same_ends_there(finished: Toy) -> None:
    assert ran(run(finished, RunOptions(refresh=("scaled",)))) == {"scaled": 5}
    assert ran(run(finished, RunOptions(refresh=("mean:1.txt",)))) == {"mean": 1}
    assert ran(finished.run()) == {}


def test_refresh_of_a_unit_that_there_is_not_says_so(toy: Toy) -> None:
    assert any("--refresh mean:7.txt" in warning for warning in run(toy, RunOptions(refresh=("mean:7.txt",))).warnings)
    assert not run(toy, RunOptions(refresh=("mean:1.txt",))).warnings


@pytest.mark.slow
def test_accepted_code_keeps_what_was_computed(finished: Toy) -> None:
    finished.edit(
        "plug.py", lambda text: text.replace("double(x.value) * params.by / 2", "double(x.value) / 2 * params.by")
    )
    assert ran(finished.run("scaled.by=4"))["scaled"] == 5
    finished.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    finished.run()
    finished.edit("plug.py", lambda text: text.replace("13 == x.value", "x.value in (13,)"))
    options = RunOptions(accept_code=True)
    session = finished.session()
    plans = make_plan(session.workflow, session.graph, Store(session.store_root), options=options)
    assert sum(len(plan.run) + len(plan.may_run) for plan in plans) == 0
    assert finished.plan()["images"].run, "a plan that accepts keeps nothing"
    assert ran(run(finished, options)) == {}
    assert ran(finished.run()) == {}, "what was accepted once is cached"


def test_code_that_changed_with_a_setting_is_not_accepted(finished: Toy) -> None:
    finished.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 5"))
    assert ran(run(finished, RunOptions(accept_code=True)))["scaled"] == 5


def test_an_upgraded_library_costs_what_uses_it_and_can_be_accepted(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numba": "0.61.2"})
    toy.run()
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numba": "0.62.0"})
    assert set(toy.plan()["images"].run.values()) == {"numba 0.61.2 → 0.62.0"}
    assert ran(run(toy, RunOptions(accept_code=True))) == {}
    toy.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numpy": "2.0.0"})
    assert "code of toy.source changed" in toy.plan()["images"].run["1.txt"]
    assert ran(run(toy, RunOptions(accept_code=True))) == {}, "changed code may use other libraries"


def test_random_numbers_are_those_of_before_when_only_the_code_has_changed(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def noted(rng: np.random.Generator, *others: Any) -> Context:
        seeds.append(int(rng.integers(2**60)))
        return Context(rng, *others)

    monkeypatch.setattr(execute, "Context", noted)
    toy.run()
    before = sorted(seeds)
    seeds.clear()
    toy.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    toy.run()
    assert before
    assert set(seeds) <= set(before)
    assert len(set(before)) == len(before), "each unit draws its own"


def test_keep_going_goes_on_where_the_workflow_would_stop(toy: Toy) -> None:
    toy.number("3.txt", "13")
    toy.edit("wf.yaml", lambda text: text.replace("by: 3}", "by: 3, on_error: stop}"))
    assert run(toy, RunOptions()).exit_code == 4
    assert run(toy, RunOptions(keep_going=True)).exit_code == 3


@pytest.mark.parametrize("options", [RunOptions(until=("nowhere",)), RunOptions(refresh=("nowhere:a",))])
def test_stage_that_is_not_there_is_named(toy: Toy, options: RunOptions) -> None:
    with pytest.raises(UsageError, match="no stage 'nowhere'"):
        run(toy, options)


def test_unit_that_is_not_there_is_named(toy: Toy) -> None:
    with pytest.raises(UsageError, match=r"mean has no unit '9\.txt'"):
        run(toy, RunOptions(only=("mean:9.txt",)))


def test_plan_says_what_was_asked_for(finished: Toy) -> None:
    session = finished.session()
    options = RunOptions(until=("mean",), refresh=("scaled:1.txt",))
    workflow, graph = options.applied_to(session.workflow, session.graph)
    plans = make_plan(workflow, graph, Store(session.store_root), options=options)
    assert {plan.name: plan.run for plan in plans if plan.run} == {"scaled": {"1.txt": "--refresh"}}
    assert plans[-1].name == "mean"
