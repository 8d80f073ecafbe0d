"""A stage's settings default to what its algorithm was tuned to."""

from __future__ import annotations

import inspect
from dataclasses import fields

import pytest

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.confidence import require_confidence
from pano_mvs.algorithms.filters.consistency import checked_with_agreement
from pano_mvs.algorithms.filters.fill import fill_from_neighbours
from pano_mvs.algorithms.filters.gaussian import gaussian_range
from pano_mvs.algorithms.filters.guided import guided_range
from pano_mvs.algorithms.filters.median import median_range
from pano_mvs.algorithms.filters.planes import lay_planes
from pano_mvs.algorithms.filters.speckle import remove_speckles
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.masks.one_color import areas_of_color
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.neighbours import loop_closing_pairs, position_pairs, retrieval_pairs
from pano_mvs.algorithms.matching.preemptive import hopeless_reason
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.algorithms.mesh.poisson import solve_poisson
from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_tracks
from pano_mvs.algorithms.poses.colmap.sift import colmap_sift
from pano_mvs.algorithms.poses.colmap.solver import solve_colmap
from pano_mvs.algorithms.poses.extension import extend_poses
from pano_mvs.algorithms.poses.frame.georeference import fit_gps
from pano_mvs.algorithms.poses.frame.levelling import level_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.algorithms.views import select_views
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.clouds.thinning import Selection

FUNCTIONS = {
    "features.sift_tangent": extract_sift,
    "features.orb_tangent": extract_orb,
    "features.sphorb": extract_sphorb,
    "mask.color": areas_of_color,
    "pairs.sequential": loop_closing_pairs,
    "pairs.position": position_pairs,
    "pairs.retrieval": retrieval_pairs,
    "global.vlad": vlad_descriptor,
    "poses.scaled_translation": solve_scaled_translation,
    "poses.colmap": solve_colmap,
    "poses.colmap_sift": colmap_sift,
    "poses.extend": extend_poses,
    "poses.refine": refine_poses,
    "poses.triangulate": triangulate_tracks,
    "poses.level": level_poses,
    "poses.scale": fit_gps,
    "depth.patchmatch": refine_range,
    "filters.median": median_range,
    "filters.gaussian": gaussian_range,
    "filters.guided": guided_range,
    "filters.planes": lay_planes,
    "filters.confidence": require_confidence,
    "filters.speckle": remove_speckles,
    "filters.consistency": checked_with_agreement,
    "filters.fast_bilateral_solver": fast_bilateral_solver,
    "filters.fill": fill_from_neighbours,
    "fusion.vote": FusionSettings,
    "export.mesh": solve_poisson,
    "export.ply": Selection,
}


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


def test_matcher_and_sweep_and_views_too() -> None:
    matcher = function_defaults(match_features) | function_defaults(hopeless_reason) | function_defaults(verify_pair)
    ours = stage_defaults("matches.brute_force")
    assert ours == {key: matcher[key] for key in ours}
    sweep = stage_defaults("depth.sweep")
    settings = {field.name: field.default for field in fields(SweepSettings)}
    assert {key: sweep[key] for key in settings} == settings
    assert stage_defaults("views.nearest")["sources"] == function_defaults(select_views)["count"]
