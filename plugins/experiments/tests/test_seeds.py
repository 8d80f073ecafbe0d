"""Which stages draw random numbers, and how a seed changes them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

from pano_mvs_experiments.seeds import drawing_stages, draws, seed_overrides

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.session.session import open_session
from tests.engine.conftest import Toy

DRAWING = {
    "depth.floors",
    "depth.scene_planes",
    "filters.planes",
    "matches.brute_force",
    "matches.lightglue",
    "points.tracked",
    "poses.colmap",
    "poses.colmap_sift",
    "poses.localise",
    "poses.scale",
    "poses.scaled_translation",
}


def test_the_stages_that_draw_are_known() -> None:
    assert {name for name, spec in Registry.installed().stages.items() if draws(spec)} == DRAWING


def test_code_in_another_environment_may_draw() -> None:
    remote = SimpleNamespace(code=None, outcome=None, close=None)
    elsewhere = [replace(spec, remote=remote) for spec in Registry.installed().stages.values()]
    assert {spec.name for spec in elsewhere if draws(spec)} > DRAWING
    assert all(draws(spec) == ("ctx" in spec.extras.values()) for spec in elsewhere)


def test_a_function_that_takes_the_context_counts(toy: Toy) -> None:
    assert drawing_stages(toy.session().workflow) == ["all"]
    helper = "def noisy(ctx: Context) -> float:\n    return [ctx.rng.random() for _ in range(1)][0]\n\n\n"
    toy.edit("plug.py", lambda text: text.replace('@stage("toy.mean")', f'{helper}@stage("toy.mean")'))
    toy.edit("plug.py", lambda text: text.replace("around: Near[Number])", "around: Near[Number], ctx: Context)"))
    toy.begin("noisy(ctx)", of="Mean of the neighbours and the own.")
    assert drawing_stages(toy.session().workflow) == ["mean", "all"]


def test_seed_0_is_that_of_an_ordinary_run() -> None:
    workflow = open_session("quickstart").workflow
    assert seed_overrides(workflow, 0) == []
    assert "poses.rng_seed=2" in seed_overrides(workflow, 2)
    assert not any(override.startswith("depth.") for override in seed_overrides(workflow, 2))
