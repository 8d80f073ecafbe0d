"""The benchmarks of depth measure what they say: on tiny scenes, with settings whose effect is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.filters.uncertainty import EXPONENTS, FACTOR, probability_within
from pano_mvs.algorithms.scales import sharp_halvings
from pano_mvs.algorithms.structure.laid_coefficients import FITTED as LAID
from pano_mvs.algorithms.sweep import hypotheses
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap, Record
from tests.synthetic.places import window_room
from tests.synthetic.scenes import weak_room, white_room, write_scene
from tools.benchmarks.captures import Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.depth import ablation, laid
from tools.benchmarks.depth.ablation import Ablation, gains, place_rows, real_rows, synthetic_rows
from tools.benchmarks.depth.layouts import OPENING, layout_ranges, view_shares
from tools.benchmarks.depth.mechanisms import FULL, MECHANISMS, Mechanism
from tools.benchmarks.depth.places import SYNTHETIC, Place, masked, places_of
from tools.benchmarks.depth.plans import Samples, TrueStorey, compared, figures, true_storeys
from tools.benchmarks.depth.scores import completeness, kept_at_precision, score_place, thicknesses
from tools.benchmarks.poses.tours.materials import PLASTER
from tools.benchmarks.poses.tours.plan import level_rotation
from tools.benchmarks.poses.tours.rendering import Boxes, first_surfaces, unlit
from tools.benchmarks.tables import reported
from tools.benchmarks.uncertainty import deviations, fit, halved_truth, left_out, read_errors

ROOM = Place("weak_room", 64, 2, arguments=(("seed", 1),))
SMALL = "depth.planes=16 depth.near=1.0 depth.far=6.0"


@pytest.mark.slow
def test_every_mechanism_makes_a_valid_workflow_of_its_own(tmp_path: Path) -> None:
    keys = set()
    for one in (FULL, *MECHANISMS):
        chain = DenseChain(one.workflow("quality", tmp_path), overrides=one.settings.split())
        others = [chain.settings(name) for name in ("static", "people", "cloud")]
        keys.add(json.dumps([chain.key(), others, dict(one.constants), one.drops_uncertainty]))
    assert len(keys) == len(MECHANISMS) + 1
    assert len({one.name for one in MECHANISMS}) == len(MECHANISMS)


def test_a_removed_stage_is_bypassed(tmp_path: Path) -> None:
    exchange = next(one for one in MECHANISMS if one.name == "exchange between views")
    chain = DenseChain(exchange.workflow("quality", tmp_path))
    assert "exchanged" not in chain.dense
    assert {port: edge.producer for port, edge in chain.graph.edges["checked"].items()}["range_map"] == "plain"


def test_constants_change_for_a_while() -> None:
    before = hypotheses._NEAREST_BASELINES
    near = next(one for one in MECHANISMS if one.constants)
    with near.changed_constants():
        assert before != hypotheses._NEAREST_BASELINES
    assert before == hypotheses._NEAREST_BASELINES


def test_an_interrupted_ablation_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full, mechanism = replace(FULL, settings=SMALL), Mechanism("8", "solver", SMALL, stages={"smooth": None})
    monkeypatch.setattr(ablation, "FULL", full)
    run = Ablation("known_poses", tmp_path / "scratch", tmp_path / "figures.json")
    found = run.measure([ROOM], [])
    assert found[FULL.name]["weak room"]["confirmed"] > 0
    both = run.measure([ROOM], [mechanism])
    assert both[FULL.name] == found[FULL.name]
    assert both["solver"]["weak room"]["delta"] != found[FULL.name]["weak room"]["delta"]
    monkeypatch.setattr(ablation, "_measured", None)
    again = Ablation("known_poses", tmp_path / "scratch", tmp_path / "figures.json").measure([ROOM], [mechanism])
    assert again == both
    (row,) = synthetic_rows(again, [mechanism])
    assert row[:2] == ("8", "solver")
    assert str(row[-1]).endswith("weak room")
    assert [row[0] for row in place_rows(again, [mechanism], ["weak room"])] == ["score of the workflow", "solver"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return scene_capture(weak_room(views=3), tmp_path_factory.mktemp("scene"), width=64)


def test_chains_share_the_maps_of_equal_stages(capture: Capture) -> None:
    memory: dict[str, Record] = {}
    names = list(capture.panoramas)
    plain = DenseChain("known_poses", overrides=SMALL.split()).run(capture)
    assert list(plain.range_maps) == ["depth", "checked", "sky", "smooth"]
    assert all(list(step) == names for step in plain.range_maps.values())
    for extra in ("", "", "smooth.smoothness=2"):
        chain = DenseChain("known_poses", overrides=[*SMALL.split(), *extra.split()], memory=memory)
        run = chain.run(capture, label="room", references=names[:1])
        # The check needs the ranges of all views.
        assert {stage: len(maps) for stage, maps in run.range_maps.items()} == {
            "depth": 3,
            "checked": 1,
            "sky": 1,
            "smooth": 1,
        }
        ranges = run.range_maps["smooth"][names[0]].range
        assert np.array_equal(ranges, plain.range_maps["smooth"][names[0]].range, equal_nan=True) == (not extra)
    made = [key.split("-")[2] for key in memory]
    assert {stage: made.count(stage) for stage in made} == {"depth": 3, "checked": 1, "sky": 1, "smooth": 2}


def test_overrides_reach_the_stages(capture: Capture) -> None:
    chain = DenseChain("known_poses", overrides=[*SMALL.split(), "depth.far=1.5"])
    chain.dense = ["depth"]
    near = chain.run(capture, references=["000.png"])
    assert list(near.range_maps["depth"]) == ["000.png"]
    assert np.nanmax(near.range_maps["depth"]["000.png"].range) <= 1.6


def test_gains_are_what_a_mechanism_adds() -> None:
    full = {"a": {"delta": 60.0, "kept": 50.0, "surface_f": 40.0}, "real": {"confirmed": 70.0}}
    without = {"a": {"delta": 57.0, "kept": 50.0, "surface_f": 40.0}, "real": {"confirmed": 65.0}}
    assert gains(full, without, "score", sign=1) == {"a": pytest.approx(1.0)}
    assert gains(full, without, "delta", sign=-1) == {"a": -3.0}
    assert gains(full, without, "confirmed", sign=1) == {"real": 5.0}


def test_real_places_show_what_can_be_measured_without_truth() -> None:
    figures = {"confirmed": 70.0, "valid": 95.0, "thickness": 0.0123, "cloud_complete": 80.0, "cpu_s": 1.0}
    one = MECHANISMS[0]
    rows = list(real_rows({FULL.name: {"flat": figures}, one.name: {"flat": figures}}, [one], "flat"))
    assert rows[-1] == (f"without {one.name}", "70.0", "95.0", "0.0123", "80.0", "1.0")


@pytest.mark.slow
def test_a_tripod_is_masked_and_has_no_true_range(tmp_path: Path) -> None:
    place = replace(ROOM, width=256, views=3, rig="tripod")
    capture = place.capture(tmp_path)
    true = next(iter(capture.ranges.values()))
    assert np.isnan(true[-1]).all()
    folder = tmp_path / "masks"
    folder.mkdir()
    found = masked(capture, DenseChain("quality", overrides=["people.enabled=false"]), folder=folder)
    hidden = ~next(iter(found.panoramas.values())).load_mask()
    assert hidden[np.isnan(true)].mean() > 0.8


def test_places_are_of_every_kind(tmp_path: Path) -> None:
    (tmp_path / "flat" / "colmap").mkdir(parents=True)
    places = places_of([tmp_path / "flat", tmp_path / "room"], width=512)
    assert [place.has_rig for place in places[len(SYNTHETIC) :]] == [True, False]
    assert len({place.key for place in places}) == len(places) == len({place.name for place in places})
    for needs in ("", "rig", "soft"):
        assert any(place.is_for(needs) for place in SYNTHETIC)
    assert [place.is_for("") for place in SYNTHETIC] == [not place.soft for place in SYNTHETIC]


@pytest.mark.slow
def test_a_soft_image_is_reduced(tmp_path: Path) -> None:
    soft = next(place for place in SYNTHETIC if place.soft)
    capture = replace(soft, views=1).capture(tmp_path)
    assert sharp_halvings(next(iter(capture.panoramas.values())).load()) == 1


def test_the_sky_is_seen_through_the_windows_of_a_room_alone() -> None:
    _, ranges = window_room(turned=False).view(0, (64, 128), supersample=1)
    nothing = np.argwhere(np.isnan(ranges))
    assert 20 < len(nothing) < 400
    # Above the horizon, ahead (columns around 64) and to the right (around 96), but not overhead.
    assert nothing[:, 0].min() > 8
    assert nothing[:, 0].max() < 34
    assert nothing[:, 1].min() > 40
    assert nothing[:, 1].max() < 112


def test_a_capture_on_disk_is_the_scene(tmp_path: Path, capture: Capture) -> None:
    write_scene(tmp_path, weak_room(views=3), (32, 64))
    read = read_capture(tmp_path)
    assert list(read.panoramas) == list(capture.panoramas)
    for name, ranges in capture.ranges.items():
        np.testing.assert_array_equal(read.ranges[name], ranges)
        np.testing.assert_array_equal(read.panoramas[name].load(), capture.panoramas[name].load())
        np.testing.assert_allclose(read.poses[name].translation, capture.poses[name].translation, atol=1e-12)
    half = read_capture(tmp_path, width=32).first(2)
    assert [panorama.load().shape for panorama in half.panoramas.values()] == [(16, 32, 3)] * 2
    assert all(ranges.shape == (16, 32) for ranges in half.ranges.values())


def test_the_papers_figures_stand_where_they_belong() -> None:
    assert reported("classroom", 4, 7, "estimated") == "0.193 / 27.18"
    assert reported("smallroom", 2, 9, "estimated") == "21.27"
    assert reported("smallroom", 2, 9, "known") == reported("court", 4, 7, "known") == "–"


@pytest.mark.slow
def test_quickstart_gives_a_plain_ceiling_its_plane(tmp_path: Path) -> None:
    """With census alone, plain surfaces win at chance ranges, and no plane fits them."""
    room = scene_capture(white_room(views=3, seed=12), tmp_path, width=192)
    name = "000.png"
    run = DenseChain("quickstart", overrides=["depth.planes=64"]).run(room, references=[name])
    found, truth = run.range_maps["planes"][name], room.ranges[name]
    above = (ray_grid((96, 192)) @ room.poses[name].rotation)[..., 1] < -0.7
    assert (np.abs(found.range / truth - 1) < 0.05)[above].mean() > 0.6


def test_pixels_are_kept_until_precision_falls() -> None:
    confidence = np.array([200, 180, 160, 140], np.uint8)
    right = np.array([True, True, False, False])
    assert kept_at_precision(confidence, right, np.ones(4), precision=1.0) == 2
    # Half of the third pixel: (2 + 0) / 2.5 = 0.8.
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.8) == pytest.approx(2.5)
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.5) == 4


def test_the_largest_share_counts_even_if_the_surest_pixels_are_wrong() -> None:
    confidence = np.array([200, 180, 160, 140], np.uint8)
    right = np.array([False, True, True, True])
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.75) == 4
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.9) == 0


def test_ranges_in_the_sky_are_wrong() -> None:
    truth = np.full((8, 16), 2.0, np.float32)
    truth[:4] = np.nan
    perfect = RangeMap(truth, np.where(np.isfinite(truth), 200, 0).astype(np.uint8))
    scores = score_place([perfect], [perfect], [truth])
    assert (scores["delta"], scores["kept"], scores["surface_f"]) == pytest.approx((100, 100, 100))
    everywhere = RangeMap(np.full((8, 16), 2.0, np.float32), np.full((8, 16), 200, np.uint8))
    scores = score_place([everywhere], [everywhere], [truth])
    assert (scores["delta"], scores["kept"], scores["surface_f"]) == pytest.approx((100, 0, 100 * 2 / 3))
    assert (scores["confirmed"], scores["confirmed_delta"]) == pytest.approx((200, 50))


def test_the_exponents_of_uncertainty_are_those_of_the_stored_errors() -> None:
    errors = read_errors()
    factor, exponents = fit(errors)
    assert factor == pytest.approx(FACTOR, abs=0.02)
    assert exponents == pytest.approx(EXPONENTS, abs=0.02)


def test_errors_are_within_two_standard_deviations_in_places_that_were_left_out() -> None:
    errors = read_errors()
    within = left_out(errors)
    shares = {name: within[errors.place == name].mean() for name in np.unique(errors.place)}
    assert min(shares.values()) > 0.8
    assert np.mean(list(shares.values())) > 0.93
    walls = np.char.startswith(errors.surface.astype(str), "walls")
    assert 0.92 < within[walls].mean() < 0.98


def test_confidence_is_right_as_often_as_it_says() -> None:
    """The share within 2 % in each quarter of the probability; below a half, it says too little."""
    errors = read_errors()
    probability = probability_within(deviations(errors, FACTOR, EXPONENTS), 0.02)
    for least in (0.25, 0.5, 0.75):
        here = (probability >= least) & (probability < least + 0.25)
        excess = (errors.error[here] < 0.02).mean() - probability[here].mean()
        assert -0.05 < excess < (0.2 if least < 0.5 else 0.05)


def test_the_model_of_laid_planes_is_that_of_the_stored_pixels() -> None:
    fitted = laid.fit(laid.read())
    assert fitted.intercept == pytest.approx(LAID.intercept, abs=0.02)
    for name, term in LAID.terms.items():
        assert fitted.terms[name].losses == pytest.approx(term.losses, abs=0.05)


@pytest.mark.slow
def test_planes_are_laid_where_they_are_better_in_places_that_were_left_out() -> None:
    pixels = laid.read()
    kept = laid.left_out(pixels)
    assert kept[pixels.better].mean() > 0.9
    assert kept[~pixels.better].mean() < 0.55


def test_a_halved_plane_is_the_plane_and_edges_do_not_mix() -> None:
    inverse = np.broadcast_to(np.linspace(0.2, 0.4, 40), (20, 40))
    halved = halved_truth((1 / inverse).astype(np.float32))
    np.testing.assert_allclose(1 / halved[0], inverse[0].reshape(-1, 2).mean(axis=1), rtol=1e-5)
    edge = np.where(np.arange(40) < 21, 2.0, 4.0) * np.ones((20, 1))
    assert set(np.unique(halved_truth(edge.astype(np.float32)))) == {2.0, 4.0}


def test_the_thickness_of_a_slab_is_its_deviation() -> None:
    rng = np.random.default_rng(0)
    slab = np.column_stack([rng.uniform(-3, 3, (4000, 2)), rng.normal(0, 0.02, 4000)])
    assert abs(np.median(thicknesses(slab, 0.5)) - 0.02) < 0.002


def test_half_a_sphere_is_half_complete() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60_000, 3))
    upper = points[points[:, 1] > 0]
    assert abs(completeness(points, np.zeros((1, 3))) - 1) < 0.01
    assert abs(completeness(upper, np.zeros((1, 3))) - 0.5) < 0.01


@pytest.mark.slow
def test_the_range_of_a_rendered_wall_is_exact() -> None:
    wall = Boxes(np.array([[0.0, 2.1, 0.0, 9.0, 0.1, 9.0, 1.0, 0.0]]), np.array([[PLASTER, 0]]), np.ones((1, 3)))
    pose = Rigid3.from_center(level_rotation(0.0, np.zeros(2)), np.zeros(3))  # towards y
    ranges, box, face = first_surfaces(unlit(wall, seed=0), pose, (16, 32))
    ahead = ray_grid((16, 32))[..., 2]
    seen = ahead > 0.5
    np.testing.assert_allclose(ranges[seen], 2.0 / ahead[seen])
    assert (box[seen] == 0).all()
    assert (face[seen] == 2).all()  # −y
    assert (box[ahead < 0] == -1).all()


def test_a_view_of_a_drawn_room_is_compared_in_both_scales() -> None:
    """All ranges are half too large, as if the camera were placed wrong."""
    openings: dict[str, list[list[float]]] = {"doors": [[2, -0.5], [2, 0.5], [-1, 0.2]], "windows": [], "openings": []}
    layout = {"vertices": [[2, 2], [2, -2], [-2, -2], [-2, 2]], **openings}
    panorama = {"layout_raw": layout, "ceiling_height": 1.6, "camera_height": 1.0}
    truth, kind = layout_ranges(panorama, (64, 128))
    assert (kind == OPENING).any()
    ranges = np.where(kind == OPENING, 9.0, 1.5 * truth)  # another room behind the door
    shares = view_shares(panorama, ranges, np.full(truth.shape, 200, np.uint8))
    assert shares["confirmed, within 5 %"] == (0.0, 1.0)
    assert shares["walls within 5 %"] == (0.0, 1.0)


@pytest.mark.slow
def test_the_true_plan_of_a_house_has_no_errors() -> None:
    lower, upper = true_storeys("house_08")
    assert upper.floor > lower.floor + 2
    for storey in (lower, upper):
        drawn = drawn_as_it_is(storey)
        count, doors, leaves = len(storey.rooms), len(storey.doors), sum(end is not None for end in storey.leaf_ends)
        assert count > 3
        assert leaves > 0
        assert figures(compared(storey, storey.walls, drawn)) == (
            *("100.0 %", "0.0 cm", "0.0 cm", "0.0 %"),
            *(f"{count} of {count}", "0.0 %", f"{doors} of {doors}, 0 wrong", f"0 of {len(storey.windows)}, 0 wrong"),
            f"{leaves} of {leaves}, 0 wrong",
            *(f"0.0, 0.0 cm, 100 % of {2 * count}", f"0.0, 0.0 cm, 100 % of {count}", "0, 0 cm", "0, 0 cm"),
        )


def drawn_as_it_is(storey: TrueStorey) -> dict[str, Any]:
    """Return what floor_plan.json would state of a storey without an error; no window is drawn."""
    rooms = [
        {
            "outline": [(x0, y0), (x1, y0), (x1, y1), (x0, y1)],
            "size": sorted((x1 - x0, y1 - y0), reverse=True),
            "size_stds": [0.01, 0.01],
            "height": storey.height,
            "height_std": 0.01,
        }
        for x0, y0, x1, y1 in storey.rooms
    ]
    openings = [
        {"kind": "door", "ends": door, "leaf": end and {"open_end": end}, "bottom": bottom, "top": top}
        for door, end, (bottom, top) in zip(storey.doors, storey.leaf_ends, storey.levels, strict=False)
    ]
    return {"rooms": rooms, "openings": openings}


@pytest.mark.slow
def test_sizes_and_leaves_that_are_wrong_are_counted() -> None:
    (storey,) = true_storeys("house_11")
    drawn = drawn_as_it_is(storey)
    drawn["rooms"][0]["size"][0] += 0.05  # five times its standard deviation
    door = next(one for one in drawn["openings"] if one["leaf"])
    door["leaf"] = {"open_end": (door["leaf"]["open_end"][0], door["leaf"]["open_end"][1] + 1.0)}
    door["top"] += 0.2
    found = compared(storey, storey.walls, drawn)
    sizes, leaves = found["sizes"], sum(end is not None for end in storey.leaf_ends)
    assert np.abs(sizes[:, 0]).max() == pytest.approx(0.05)
    assert np.mean(np.abs(sizes[:, 0]) <= 2 * sizes[:, 1]) == pytest.approx(1 - 1 / len(sizes))
    assert found["leaves"].tolist() == [leaves - 1, leaves, 1]
    assert np.abs(found["levels"]).max() == pytest.approx(0.2)


@pytest.mark.slow
def test_a_plan_that_is_moved_has_its_errors() -> None:
    (storey,) = true_storeys("house_11")
    moved = Samples(storey.walls.xy + np.array([0.03, 0.03]), storey.walls.along)
    assert figures(compared(storey, moved, {}))[:4] == ("100.0 %", "3.0 cm", "3.0 cm", "0.0 %")
    beside = Samples(storey.walls.xy + np.array([20.0, 0.0]), storey.walls.along)
    assert figures(compared(storey, beside, {}))[0] == "0.0 %"
