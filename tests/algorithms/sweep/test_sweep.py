"""Laws of the sphere sweep, and what it recovers from a room whose range is known."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.hypotheses import mean_baseline_of, virtual_ranges
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle, roll_panorama, rotate_panorama, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import Texture, capture_poses, default_room, render
from pano_mvs.testing.sweep_backends import plane_position

NEAR, FAR = 0.5, 6.0
FAST = SweepSettings(planes=24, window=5)
PAPER = SweepSettings(
    planes=32,
    spacing="uniform",
    cost="sad",
    spherical_window=False,
    combination="sum",
    aggregation="box",
    selection="winner",
)


@functools.cache
def _capture(
    height: int, count: int = 3, texture: Texture = "strong"
) -> tuple[tuple[NDArray[np.uint8], ...], tuple[Rigid3, ...], NDArray[np.float32]]:
    """Return pictures, source_from_reference and the true range of view 0 of a room."""
    poses = capture_poses(count, seed=5)
    views = [render(default_room(1, texture), pose, (height, 2 * height)) for pose in poses]
    relative = tuple(pose @ poses[0].inverse() for pose in poses[1:])
    return tuple(picture for picture, _ in views), relative, views[0][1]


def _sweep(
    pictures: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], settings: SweepSettings = FAST, **options: Any
) -> RangeMap:
    limits = {"near": NEAR, "far": FAR} | options
    return sweep_range(pictures[0], pictures[1:], poses, settings=settings, **limits)


def _share_within(result: RangeMap, truth: NDArray[np.float32], ratio: float) -> float:
    weight = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)
    with np.errstate(invalid="ignore"):
        good = np.maximum(result.range / truth, truth / result.range) < ratio
    return float(np.sum(weight * good) / weight.sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "masked", "source_height"),
    [
        (SweepSettings(planes=20), True, 48),
        (SweepSettings(planes=20, aggregation="box", spacing="log", p2_contrast=0), True, 32),
        (SweepSettings(planes=20, cost="sad", aggregation="sgm", prefilter_diameter=3), False, 20),
        (SweepSettings(planes=20, cost="zncc", combination="parallax_weighted", selection="vfit"), True, 32),
        (SweepSettings(planes=20, cost="sad_gradient", combination="best_k", confidence="combined"), True, 24),
        (SweepSettings(planes=20, cost="census_gradient", window=5, support=3, aggregation="box"), False, 32),
        (PAPER.replace(selection="parabola", combination="best_half", spherical_window=True, exposure=False), True, 24),
    ],
)
def test_the_compiled_sweep_equals_the_readable_one(settings: SweepSettings, masked: bool, source_height: int) -> None:
    """With settings that the cases of `test_every_backend_gives_the_winners_of_the_readable_one` leave out."""
    pictures, poses, _ = _capture(32, 4)
    others, _, _ = _capture(source_height, 4)
    pictures = (pictures[0], others[1], *pictures[2:])
    masks = [np.ones(picture.shape[:2], np.bool_) for picture in pictures]
    for mask in masks if masked else []:
        mask[-5:] = False
    options = {"reference_mask": masks[0], "source_masks": masks[1:]}
    fast = _sweep(pictures, poses, settings, **options)
    plain = _sweep(pictures, poses, settings, backend="numpy", **options)
    fast.check()
    plain.check()
    levels = np.abs(_position(fast.range, settings) - _position(plain.range, settings))
    same = (levels < 0.5) | (np.isnan(fast.range) & np.isnan(plain.range))
    assert same.mean() >= 0.99
    assert (np.abs(fast.confidence.astype(int) - plain.confidence) <= 1).mean() >= 0.98


@pytest.mark.kernel(
    "sweep.numba.kernels_band", "sweep.numba.kernels_sgm", "sweep.numba.kernels_lookup", "sweep.numba.kernels_winner"
)
@pytest.mark.parametrize("changes", [{}, {"cost": "sad", "aggregation": "box"}])
def test_a_tiny_sweep_equals_the_readable_one(changes: dict[str, str]) -> None:
    """Small enough to run as plain Python too."""
    settings = SweepSettings(planes=6, window=3, support=3).replace(**changes)
    pictures, poses, _ = _capture(16)
    fast, plain = (_sweep(pictures, poses, settings, backend=backend) for backend in ("numba", "numpy"))
    levels = np.abs(_position(fast.range, settings) - _position(plain.range, settings))
    assert np.mean((levels < 0.5) | (np.isnan(fast.range) & np.isnan(plain.range))) >= 0.99
    assert np.isfinite(fast.range).mean() > 0.7


def _position(ranges: NDArray[np.float32], settings: SweepSettings) -> NDArray[np.float64]:
    _, poses, _ = _capture(16)  # the same at any size
    baseline = mean_baseline_of(poses)
    hypotheses = virtual_ranges(NEAR, FAR, planes=settings.planes, spacing=settings.spacing, baseline=baseline)
    return plane_position(ranges, hypotheses)


@pytest.mark.parametrize("settings", [FAST, PAPER, FAST.replace(aggregation="box")])
@pytest.mark.parametrize("columns", [1, 17, 64])
def test_rolling_all_pictures_rolls_the_range(settings: SweepSettings, columns: int) -> None:
    pictures, poses, _ = _capture(64)
    turn = Rigid3(roll_panorama(pictures[0], columns)[1], np.zeros(3))
    rolled = tuple(np.roll(picture, columns, axis=1) for picture in pictures)
    result = _sweep(rolled, [turn @ pose @ turn.inverse() for pose in poses], settings)
    difference = np.abs(np.roll(result.range, -columns, axis=1) / _sweep(pictures, poses, settings).range - 1)
    assert np.median(difference) < 1e-5
    assert (difference > 1e-3).mean() < 0.005
    assert (difference[:, :4] > 1e-3).mean() < 0.03


def test_turning_a_source_about_its_centre_changes_little() -> None:
    pictures, poses, truth = _capture(64)
    turn = rotation_from_rotvec((0.9, 0.5, -0.3))
    turned = (pictures[0], rotate_panorama(pictures[1], turn), pictures[2])
    result = _sweep(turned, [Rigid3(turn, np.zeros(3)) @ poses[0], poses[1]])
    assert _share_within(result, _sweep(pictures, poses).range, 1.05) > 0.86
    assert _share_within(result, truth, 1.1) > 0.95 * _share_within(_sweep(pictures, poses), truth, 1.1)


def test_a_world_twice_as_large_has_twice_the_range() -> None:
    pictures, poses, _ = _capture(32)
    larger = [Rigid3(pose.rotation, 2 * pose.translation) for pose in poses]
    result = _sweep(pictures, larger, near=2 * NEAR, far=2 * FAR)
    np.testing.assert_allclose(result.range, 2 * _sweep(pictures, poses).range, rtol=1e-5)


def test_the_number_of_threads_changes_no_byte() -> None:
    pictures, poses, _ = _capture(64)
    threads = numba.get_num_threads()
    results = []
    for settings in (FAST, FAST.replace(aggregation="box")):
        for count in (1, threads):
            numba.set_num_threads(count)
            results.append(_sweep(pictures, poses, settings))
    for one, many in (results[:2], results[2:]):
        assert one.range.tobytes() == many.range.tobytes()
        assert one.confidence.tobytes() == many.confidence.tobytes()


@pytest.mark.slow
def test_the_room_is_recovered_up_to_the_poles_and_the_seam() -> None:
    pictures, poses, truth = _capture(128, 4)
    result = _sweep(pictures, poses, SweepSettings(planes=64))
    result.check()
    assert np.isfinite(result.range).all()
    assert _share_within(result, truth, 1.05) > 0.9
    relative = np.abs(result.range / truth - 1)
    assert np.median(relative) < 0.01
    for border in (relative[:3], relative[-3:], relative[:, :3], relative[:, -3:]):
        assert np.median(border) < 0.02
    assert result.confidence.min() >= 64
    assert result.confidence.max() <= 127


def test_census_and_paths_beat_the_paper_on_plain_walls() -> None:
    pictures, poses, truth = _capture(64, 4, "weak")
    paper = _sweep(pictures, poses, PAPER.replace(planes=64))
    ours = _sweep(pictures, poses, SweepSettings(planes=64))
    assert _share_within(ours, truth, 1.05) > _share_within(paper, truth, 1.05) + 0.05


@pytest.mark.parametrize("settings", [SweepSettings(planes=64), SweepSettings(planes=64, aggregation="box")])
def test_the_surer_half_is_much_the_better_one(settings: SweepSettings) -> None:
    pictures, poses, truth = _capture(64, 4, "weak")
    result = _sweep(pictures, poses, settings)
    error = np.abs(np.log(result.range / truth))
    sure = result.confidence > np.median(result.confidence)
    assert error[sure].mean() < 0.5 * error[~sure].mean()


def test_nothing_is_sure_where_there_is_nothing_to_see() -> None:
    plain = np.full((32, 64, 3), 128, np.uint8)
    pose = Rigid3(np.eye(3), np.array([0.3, 0, 0]))
    assert _sweep((plain, plain), [pose], FAST.replace(no_match="keep")).confidence.max() == 64
    assert not _sweep((plain, plain), [pose]).valid.any()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_masked_pixels_have_no_range_and_no_vote(backend: str) -> None:
    pictures, poses, _ = _capture(32)
    spoilt = tuple(picture.copy() for picture in pictures)
    mask = np.ones((32, 64), np.bool_)
    mask[24:] = False
    for picture in spoilt:
        picture[24:] = np.random.default_rng(0).integers(0, 255, picture[24:].shape)
    masks: dict[str, Any] = {"reference_mask": mask, "source_masks": [mask, None]}
    result = _sweep(spoilt, poses, backend=backend, **masks)
    result.check()
    assert np.isnan(result.range[24:]).all()
    assert np.isfinite(result.range[:18]).all()
    nobody = [np.zeros((32, 64), np.bool_)] * 2
    assert np.isnan(_sweep(pictures, poses, backend=backend, source_masks=nobody).range).all()
    even = FAST.replace(spacing="inverse")  # the planes of "parallax" depend on all sources
    only_second = _sweep(pictures, poses, even, backend=backend, source_masks=[nobody[0], None])
    alone = _sweep((pictures[0], pictures[2]), poses[1:], even, backend=backend)
    np.testing.assert_allclose(only_second.range, alone.range, rtol=1e-5)


def test_another_exposure_does_not_ruin_differences() -> None:
    pictures, poses, truth = _capture(64)
    brighter = tuple(
        np.clip(np.rint(picture * (1.12, 1.1, 1.15) + 6), 0, 255).astype(np.uint8) for picture in pictures[1:]
    )
    settings = SweepSettings(planes=48, cost="sad", aggregation="box")
    even = _share_within(_sweep(pictures, poses, settings), truth, 1.05)
    matched = _share_within(_sweep((pictures[0], *brighter), poses, settings), truth, 1.05)
    ruined = _share_within(_sweep((pictures[0], *brighter), poses, settings.replace(exposure=False)), truth, 1.05)
    assert matched > even - 0.02
    assert ruined < even - 0.1


@pytest.mark.parametrize("size_hw", [(16, 32), (18, 36), (50, 100)])
@pytest.mark.parametrize("settings", [SweepSettings(planes=3, window=15, support=15), FAST, PAPER])
def test_small_pictures_and_large_windows_work(size_hw: tuple[int, int], settings: SweepSettings) -> None:
    rng = np.random.default_rng(0)
    pictures = list(rng.integers(0, 256, (2, *size_hw, 3), dtype=np.uint8))
    result = _sweep(pictures, [Rigid3(np.eye(3), np.array([0.3, 0.1, 0]))], settings.replace(no_match="keep"))
    result.check()
    assert np.isfinite(result.range).all()
    assert result.range.min() >= np.float32(NEAR)
    assert result.range.max() <= np.float32(FAR)


def test_calls_that_cannot_work_say_why() -> None:
    pictures, poses, _ = _capture(32)
    with pytest.raises(UsageError, match="0 < near < far"):
        _sweep(pictures, poses, near=2.0, far=1.0)
    with pytest.raises(UsageError, match="one pose"):
        _sweep(pictures, poses[:1])
    with pytest.raises(UsageError, match=r"source 0.*uint8"):
        _sweep((pictures[0], pictures[1].astype(float), pictures[2]), poses)
    with pytest.raises(UsageError, match="reference: its mask"):
        _sweep(pictures, poses, reference_mask=np.ones((3, 3), np.bool_))
    with pytest.raises(UsageError, match="even width"):
        _sweep((pictures[0][:, :-1], *pictures[1:]), poses)
    with pytest.raises(UsageError, match="backend 'cuda'"):
        _sweep(pictures, poses, backend="cuda")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"window": 6}, "window must be odd"),
        ({"window": 1}, "census needs"),
        ({"window": 1, "cost": "zncc"}, "zncc needs"),
        ({"p1": 9, "p2": 8}, "p1 ≤ p2"),
    ],
)
def test_settings_that_no_sweep_can_use_are_refused(change: dict[str, Any], what: str) -> None:
    with pytest.raises(UsageError, match=what):
        SweepSettings(**change)
