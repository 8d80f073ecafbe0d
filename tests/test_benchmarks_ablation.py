"""The ablation switches off what it says, measures each case once, and reports gains with the right sign."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.scales import sharp_halvings
from pano_mvs.algorithms.sweep import hypotheses
from pano_mvs.scene import Record
from tests.benchmarks.dense_chain import DenseChain
from tests.benchmarks.depth import ablation, sky
from tests.benchmarks.depth.ablation import Ablation, gains, place_lines, real_lines, synthetic_lines
from tests.benchmarks.depth.ablation_places import SYNTHETIC, AblationPlace, ablation_places, masked
from tests.benchmarks.depth.mechanisms import FULL, MECHANISMS, Mechanism
from tests.benchmarks.depth.stored_chain import StoredChain
from tests.synthetic.places import window_room

ROOM = AblationPlace("weak_room", 64, 2, arguments=(("seed", 1),))
SMALL = "depth.planes=16 depth.near=1.0 depth.far=6.0"


def test_every_mechanism_makes_a_valid_workflow_of_its_own(tmp_path: Path) -> None:
    keys = set()
    for one in (FULL, *MECHANISMS):
        chain = StoredChain(one.workflow("quality", tmp_path), overrides=one.settings.split())
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
    rows = [*synthetic_lines(again, [mechanism]), *place_lines(again, [mechanism])]
    assert any(row.startswith("| 8 | solver | ") and "1 weak room" not in row for row in rows)


def test_chains_share_the_maps_of_equal_stages(tmp_path: Path) -> None:
    memory: dict[str, Record] = {}
    capture = ROOM.capture(tmp_path)
    names = list(capture.panoramas)
    for extra in ("", "smooth.smoothness=2"):
        chain = StoredChain("known_poses", overrides=[*SMALL.split(), *extra.split()], memory=memory)
        chain.run(capture, label="room", references=names)
    made = [key.split("-")[2] for key in memory]
    assert {stage: made.count(stage) for stage in made} == {"depth": 2, "checked": 2, "sky": 2, "smooth": 4}


def test_gains_are_what_a_mechanism_adds() -> None:
    full = {"a": {"delta": 60.0, "kept": 50.0, "surface_f": 40.0}, "real": {"confirmed": 70.0}}
    without = {"a": {"delta": 57.0, "kept": 50.0, "surface_f": 40.0}, "real": {"confirmed": 65.0}}
    assert gains(full, without, "score", sign=1) == {"a": pytest.approx(1.0)}
    assert gains(full, without, "delta", sign=-1) == {"a": -3.0}
    assert gains(full, without, "confirmed", sign=1) == {"real": 5.0}


def test_real_places_show_what_can_be_measured_without_truth() -> None:
    figures = {"confirmed": 70.0, "valid": 95.0, "thickness": 0.0123, "cloud_complete": 80.0, "cpu_s": 1.0}
    one = MECHANISMS[0]
    rows = list(real_lines({FULL.name: {"flat": figures}, one.name: {"flat": figures}}, [one]))
    assert rows[-1] == f"| without {one.name} | 70.0 | 95.0 | 0.0123 | 80.0 | 1.0 |"


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
    places = ablation_places([tmp_path / "flat", tmp_path / "room"], width=512)
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


def test_the_sky_that_is_found_and_what_is_lost_are_shares_of_the_sphere() -> None:
    truth = np.full((8, 16), 2.0, np.float32)
    truth[:4] = np.nan
    found = np.zeros((8, 16), np.bool_)
    found[:, :4] = True
    assert sky.shares(found, truth) == pytest.approx((25, 25))
    found[:4] = True
    assert sky.shares(found, truth) == pytest.approx((100, 25))


def test_the_sky_is_seen_through_the_windows_of_a_room_alone() -> None:
    _, ranges = window_room(turned=False).view(0, (64, 128), supersample=1)
    nothing = np.argwhere(np.isnan(ranges))
    assert 20 < len(nothing) < 400
    # Above the horizon, ahead (columns around 64) and to the right (around 96), but not overhead.
    assert nothing[:, 0].min() > 8
    assert nothing[:, 0].max() < 34
    assert nothing[:, 1].min() > 40
    assert nothing[:, 1].max() < 112
