"""A stage's settings default to what its algorithm was tuned to."""

from __future__ import annotations

import inspect

import pytest

from pano_mvs.algorithms.mesh.poisson import solve_poisson
from pano_mvs.algorithms.poses.colmap.sift import colmap_sift
from pano_mvs.algorithms.poses.colmap.solver import solve_colmap
from pano_mvs.algorithms.poses.frame.georeference import fit_gps
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.clouds.thinning import Selection

FUNCTIONS = {
    "poses.colmap": solve_colmap,
    "poses.colmap_sift": colmap_sift,
    "poses.scale": fit_gps,
    "export.mesh": solve_poisson,
    "export.ply": Selection,
}
"""The algorithms of the stages that state their settings themselves; others derive them by `params_from`."""


def stage_defaults(name: str) -> dict[str, object]:
    params = Registry.installed().stages[name].params_type
    return {key: field.default for key, field in params.model_fields.items()}


def function_defaults(function: object) -> dict[str, object]:
    assert callable(function)
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_defaults_are_those_of_the_algorithm(name: str) -> None:
    ours, theirs = stage_defaults(name), function_defaults(FUNCTIONS[name])
    shared = ours.keys() & theirs.keys()
    assert shared
    assert {key: ours[key] for key in shared} == {key: theirs[key] for key in shared}
