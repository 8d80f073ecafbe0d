"""What counts as evidence for a camera, and what as none."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement import placed_model
from pano_mvs.algorithms.poses.placement.pair_evidence import geometries_of
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.verification.appearance import Appearance
from pano_mvs.algorithms.poses.verification.belief.evidence import OfImages, camera_evidence
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.algorithms.poses.aliased_capture import view_of
from tests.algorithms.poses.synthetic_capture import features_from_bearings

Edge = tuple[int, int]

CAMERAS = {idx: Rigid3.from_center(np.eye(3), np.array([idx, 0.0, idx % 2])) for idx in range(6)}
RAYS = np.random.default_rng(1).normal(size=(60, 3))
NOTHING: dict[int, OfImages] = {}


def placed(pairs: Mapping[Edge, tuple[float, ...]], *, agreeing: bool, exponent: float = -100.0) -> PlacedModel:
    """Return a model with pairs of so many geometries with these weights, of which the first agrees or none does."""
    away = Rigid3(rotation_from_rotvec((0.0, 1.0, 0.0)), np.array([0.0, 1.0, 0.0]))
    matches = np.stack([np.arange(30)] * 2, axis=1).astype(np.int32)
    geometries, compared = {}, {}
    for (a, b), weights in pairs.items():
        relative = CAMERAS[b] @ CAMERAS[a].inverse()
        view = replace(view_of(relative if agreeing else away @ relative, matches), log10_false_alarms=exponent)
        rays = features_from_bearings(RAYS).bearings
        geometries[a, b] = tuple(replace(geometries_of(view, rays, rays)[0], weight=weight) for weight in weights)
        compared[a, b] = view
    found = Pairs({f"{idx}.png": features_from_bearings(RAYS) for idx in CAMERAS}, geometries, compared=compared)
    return PlacedModel(found, dict(CAMERAS), dict.fromkeys(geometries, 0) if agreeing else {})


def test_pairs_that_disagree_and_may_be_chance_are_no_evidence() -> None:
    """Regression: known poses were doubted because three pairs of 14 to 22 matches disagreed with them."""
    pairs = {(0, 1): (1.0,), (0, 2): (1.0,)}
    weak = camera_evidence(placed(pairs, agreeing=False, exponent=-7.0), NOTHING)
    assert np.isnan(list(weak[0].values())).all()
    certain = camera_evidence(placed(pairs, agreeing=False), NOTHING)
    assert certain[0]["contradicted"] == 1
    assert certain[0]["agreeing"] == 0
    assert np.isnan(certain[5]["contradicted"])


def test_pairs_that_agree_are_evidence_however_weak() -> None:
    found = camera_evidence(placed({(0, 1): (1.0,), (0, 2): (1.0,)}, agreeing=True, exponent=-7.0), NOTHING)
    assert [found[idx]["agreeing"] for idx in (0, 1)] == [2, 1]
    assert [found[idx]["contradicted"] for idx in (0, 1)] == [0, 0]


def test_a_place_repeats_as_much_as_the_other_geometries_of_all_pairs_weigh() -> None:
    found = camera_evidence(placed({(0, 1): (1.0, 0.6, 0.2), (2, 3): (2.0,)}, agreeing=True), NOTHING)
    assert [row["repeats"] for row in found.values()] == pytest.approx([0.3] * len(CAMERAS))


def test_shares_are_compared_with_what_is_expected() -> None:
    of_images = {0: OfImages(share=0.2, expected=0.4), 1: OfImages(share=0.3, expected=0.0)}
    rows = camera_evidence(placed({}, agreeing=True), of_images)
    assert (rows[0]["share"], rows[0]["ratio"]) == (0.2, 0.5)
    assert np.isnan(rows[1]["ratio"])


def test_what_a_camera_shows_is_compared_with_other_cameras_where_something_is_expected() -> None:
    correlations = {0: 0.9, 1: 0.7, 2: 0.2}
    of_images = {
        idx: OfImages(appearance=Appearance(correlation=each, cover=0.5, unlike=0.1 * idx))
        for idx, each in correlations.items()
    }
    rows = camera_evidence(placed({}, agreeing=True), of_images | {3: OfImages(appearance=Appearance())})
    assert [rows[idx]["likeness"] for idx in range(3)] == pytest.approx([0.45, 0.15, -0.6])
    assert [rows[idx]["unlike"] for idx in range(3)] == pytest.approx([0.0, 0.1, 0.2])
    assert np.isnan([rows[3][name] for name in ("likeness", "unlike")]).all()
    alone = camera_evidence(placed({}, agreeing=True), {0: of_images[0]})
    assert np.isnan(alone[0]["likeness"])


def test_pairs_contradict_a_camera_by_their_weight() -> None:
    model = placed({(0, 1): (3.0,), (0, 2): (1.0,), (1, 2): (2.0,)}, agreeing=True)
    del model.chosen[0, 2]
    rows = camera_evidence(model, NOTHING)
    assert [rows[idx]["contradicted"] for idx in range(3)] == pytest.approx([1 / 4, 0.0, 1 / 3])
    assert np.isnan(rows[3]["contradicted"])
    assert [row["pairs_contradicting"] for row in rows.values()] == pytest.approx([(1 / 4 + 0 + 1 / 3) / 3] * 6)


def linked(
    weights: Mapping[Edge, float], monkeypatch: pytest.MonkeyPatch, *, plain: Collection[int] = ()
) -> tuple[list[float], float]:
    """Return what is measured if learned pairs have these weights, negative where they do not agree."""
    matches = np.stack([np.arange(30)] * 2, axis=1).astype(np.int32)
    away = Rigid3(rotation_from_rotvec((0.0, 1.0, 0.0)), np.array([0.0, 1.0, 0.0]))
    compared = {}
    for (a, b), weight in weights.items():
        relative = CAMERAS[b] @ CAMERAS[a].inverse()
        view = view_of(relative if weight > 0 else away @ relative, matches)
        compared[a, b] = replace(view, log10_false_alarms=-abs(weight))
    monkeypatch.setattr(placed_model, "weight_of_pair", lambda *_, log10_false_alarms: -log10_false_alarms)
    features = features_from_bearings(RAYS)
    learned = {f"{idx}.png": features if idx in plain else replace(features, learned=len(RAYS)) for idx in CAMERAS}
    rows = camera_evidence(PlacedModel(Pairs(learned, {}, compared=compared), dict(CAMERAS), {}), NOTHING)
    shares = {row["links_contradicting"] for row in rows.values() if np.isfinite(row["linked"])}
    return [rows[idx]["linked"] for idx in CAMERAS], shares.pop() if shares else np.nan


def test_a_part_is_linked_by_what_crosses_its_weakest_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms: dict[Edge, float] = {(0, 1): 5, (1, 2): 5, (0, 2): 5, (2, 3): 5, (4, 5): 4, (3, 4): 2}
    assert linked(rooms, monkeypatch) == ([5, 5, 5, 5, 2, 2], 0)
    # What contradicts counts against it; pairs inside of the part do not.
    found, share = linked({**rooms, (1, 5): -1.5}, monkeypatch)
    assert found[4:] == [0.5, 0.5]
    assert share == pytest.approx(1.5 / 28.5)
    assert linked({**rooms, (0, 5): 3}, monkeypatch)[0][4:] == [5, 5]


def test_a_camera_between_two_rooms_may_be_the_weakest_part(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms: dict[Edge, float] = {(0, 1): 9, (3, 4): 9, (1, 2): 3, (2, 3): 3, (0, 3): 8, (1, 4): 8}
    found, _ = linked({**rooms, (0, 2): -4, (2, 4): -4}, monkeypatch)
    assert found[2] == -2


def test_a_camera_without_a_pair_that_agrees_is_not_linked(monkeypatch: pytest.MonkeyPatch) -> None:
    found, share = linked({(0, 1): 5, (1, 2): 5, (2, 3): 5, (3, 4): 5, (4, 5): -2}, monkeypatch)
    assert found[5] == -2
    assert share == pytest.approx(2 / 23)
    assert np.isnan(linked({}, monkeypatch)[0]).all()


def test_what_contradicted_cameras_that_were_left_out_still_speaks_against_the_others() -> None:
    learned = replace(features_from_bearings(RAYS), learned=len(RAYS))
    matches = np.stack([np.arange(30)] * 2, axis=1).astype(np.int32)
    view = replace(view_of(CAMERAS[1] @ CAMERAS[0].inverse(), matches), log10_false_alarms=-300.0)
    pairs = Pairs({f"{idx}.png": learned for idx in CAMERAS}, {}, compared={(0, 1): view})
    model = PlacedModel(pairs, {idx: CAMERAS[idx] for idx in (0, 1)}, {})
    for before in (np.nan, 0.2):
        rows = camera_evidence(model, NOTHING, contradicting_before=before)
        assert rows[0]["links_contradicting"] == np.fmax(0.0, before)


def test_cameras_without_learned_pairs_have_no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs: dict[Edge, float] = {(0, 1): 5, (1, 2): 4, (2, 3): 6, (3, 4): 6, (4, 5): 6}
    found, _ = linked(pairs, monkeypatch, plain={3, 4, 5})
    assert found[:3] == [5, 9, 4]
    assert np.isnan(found[3:]).all()
