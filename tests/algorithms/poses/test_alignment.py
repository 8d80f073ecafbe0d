"""Alignment of tracks' observations, and adjustment that weighs them by their precision."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment import patch_alignment as alignment
from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, RobustLoss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.kernels_patch_alignment import sample_patches
from pano_mvs.algorithms.poses.adjustment.patch_alignment import align_tracks, aligned_shifts, smoothed_gray, window
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, pixel_from_ray, ray_from_pixel, rotation_from_rotvec
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import join_groups, split_groups
from pano_mvs.testing.room import default_room, render
from tests.algorithms.poses.synthetic_capture import random_rotation
from tests.known import known
from tests.oracles.poses import aligned_shift, sampled_patch

Room = tuple[Poses, dict[str, tuple[NDArray[np.uint8], NDArray[np.bool_]]]]

SIZE_HW = (256, 512)
PIXEL_RAD = 2 * np.pi / SIZE_HW[1]


def texture(rng: np.random.Generator, side: int = 80, blur: float = 2.0) -> NDArray[np.float64]:
    result: NDArray[np.float64] = 128 + 300 * cv2.GaussianBlur(rng.normal(size=(side, side)), (0, 0), blur)
    return result


def crop(picture: NDArray[Any], column: float, row: float, side: int = 21) -> NDArray[np.float32]:
    """A patch whose middle is at a place of the picture."""
    x, y = np.meshgrid(np.arange(side) - side // 2 + column, np.arange(side) - side // 2 + row)
    result: NDArray[np.float32] = cv2.remap(
        picture.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LANCZOS4
    )
    return result


@pytest.mark.kernel("poses.adjustment.kernels_patch_alignment")
def test_patches_equal_the_oracle_at_the_seam_and_at_the_poles() -> None:
    rng = np.random.default_rng(1)
    padded = smoothed_gray(rng.integers(0, 256, (32, 64, 3)).astype(np.uint8))
    middles = np.array([[0.0, 0.0, -1.0], [0.01, -1.0, 0.02], [0.0, 2.0, 0.0], [0.3, 0.4, 0.5]])
    first, second = 0.05 * rng.normal(size=(2, 4, 3))
    patches = np.empty((4, 7, 7), np.float32)
    sample_patches(padded, 8, middles, first, second, patches)
    expected = [
        sampled_patch(padded.astype(float), 8, m, (a, b), 7) for m, a, b in zip(middles, first, second, strict=True)
    ]
    np.testing.assert_allclose(patches, expected, atol=2e-3)


@pytest.mark.kernel("poses.adjustment.kernels_patch_alignment")
def test_alignment_equals_the_oracle() -> None:
    rng = np.random.default_rng(2)
    picture = texture(rng)
    places = 40 + rng.uniform(-1, 1, (3, 2))
    noise = rng.normal(0, 1, (3, 21, 21))
    patches = (np.stack([crop(picture, *place) for place in places]) + noise).astype(np.float32)
    shifts, correlations, deviations = aligned_shifts(patches, np.zeros(2, np.intp), np.arange(1, 3))
    for idx in range(2):
        expected = aligned_shift(patches[0].astype(float), patches[idx + 1].astype(float), window(), 6.0)
        np.testing.assert_allclose(shifts[idx], expected[0], atol=2e-3)
        assert correlations[idx] == pytest.approx(expected[1], abs=1e-4)
        assert deviations[idx] == pytest.approx(expected[2], rel=1e-6)


def test_alignment_recovers_a_shift_under_another_exposure() -> None:
    rng = np.random.default_rng(3)
    picture = texture(rng)
    offsets = rng.uniform(-1.2, 1.2, (30, 2))
    moved = [0.6 * crop(picture, 40 - dx, 40 - dy) + 35 for dx, dy in offsets]
    patches = np.stack([crop(picture, 40, 40), *moved]).astype(np.float32)
    shifts, correlations, _ = aligned_shifts(patches, np.zeros(30, np.intp), np.arange(1, 31))
    assert np.abs(shifts - offsets).max() < 0.05
    assert correlations.min() > 0.99


def test_deviation_is_that_of_many_draws() -> None:
    """The stated deviation, times the noise, is that of the shift; twice as large where the patch is an edge."""
    rng = np.random.default_rng(4)
    clean = crop(texture(rng), 40, 40)
    contrast = np.sqrt(
        np.average((clean[4:17, 4:17] - np.average(clean[4:17, 4:17], weights=window())) ** 2, weights=window())
    )
    noise = 0.02 * contrast
    patches = (clean + rng.normal(0, noise, (400, 21, 21))).astype(np.float32)
    patches[0] = clean
    shifts, _, deviations = aligned_shifts(patches, np.zeros(399, np.intp), np.arange(1, 400))
    along_worst = np.sqrt(np.linalg.eigvalsh(np.cov(shifts.T))[-1])
    assert 0.5 < along_worst / (0.02 * deviations[0]) < 1.5


def test_plain_patches_and_those_that_leave_the_margin_do_not_align() -> None:
    rng = np.random.default_rng(5)
    picture = texture(rng)
    patches = np.stack([crop(picture, 40, 40), np.full((21, 21), 90.0), crop(picture, 40, 49)]).astype(np.float32)
    _, correlations, _ = aligned_shifts(patches, np.array([0, 1, 0]), np.array([1, 0, 2]))
    assert correlations[:2] == pytest.approx(0, abs=1e-3)
    assert correlations[2] < 0.85


@pytest.fixture(scope="module")
def room() -> Room:
    """True poses of four cameras, their pictures, and tracks with noise of 0.4 px on textured places."""
    rng = np.random.default_rng(6)
    centers = np.array([[0, 0, 0], [0.4, 0.1, 0.2], [-0.3, -0.1, 0.3], [0.1, 0.2, -0.4]])
    cameras = {f"{n}.png": Rigid3.from_center(random_rotation(rng), center) for n, center in enumerate(centers)}
    views = [render(default_room(1), camera, SIZE_HW, supersample=1) for camera in cameras.values()]
    pictures = {name: (image, np.ones(SIZE_HW, np.bool_)) for name, (image, _) in zip(cameras, views, strict=True)}
    first = next(iter(cameras.values()))
    x, y = rng.integers(0, SIZE_HW[1], 1500), rng.integers(20, SIZE_HW[0] - 20, 1500)
    rays = ray_from_pixel(np.stack([x, y], axis=1) + 0.5, SIZE_HW)
    points = first.inverse().apply(rays * views[0][1][y, x, None])
    known = Poses.without_points(cameras, frame="x", scale="x", metric=False)
    seen = np.stack([camera.apply(points) for camera in cameras.values()], axis=1)
    true = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    noisy = true + 0.4 * PIXEL_RAD * rng.normal(size=true.shape)
    poses = replace(
        known,
        points_in_world=points,
        point_colors_rgb=np.zeros((1500, 3), np.uint8),
        point_errors_rad=np.zeros(1500, np.float32),
        track_point_idx=np.repeat(np.arange(1500, dtype=np.int32), 4),
        track_image_idx=np.tile(np.arange(4, dtype=np.int32), 1500),
        track_bearings=(noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)).reshape(-1, 3),
    )
    return poses, pictures


@pytest.fixture(scope="module")
def room_aligned(room: Room) -> Poses:
    """The tracks of the room, aligned on its pictures; not to be changed."""
    poses, pictures = room
    return align_tracks(poses, pictures.__getitem__)


def true_deviations_px(poses: Poses, of_point: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far observations are from where they would show what the first observation of their point shows."""
    moved = np.einsum(
        "tij,tj->ti", poses.rotations[poses.track_image_idx], of_point - poses.centers[poses.track_image_idx]
    )
    return angle_between(moved, poses.track_bearings) / PIXEL_RAD


def shown_points(poses: Poses, ranges: NDArray[Any]) -> NDArray[np.float64]:
    """The place in the world that the reference of each observation's track shows."""
    sightings = alignment._sightings(poses, PIXEL_RAD)
    reference = sightings.reference_idx
    image = poses.track_image_idx[reference]
    rays = np.einsum("tji,tj->ti", poses.rotations[image], poses.track_bearings[reference])
    result: NDArray[np.float64] = poses.centers[image] + ranges[reference, None] * rays
    return result


@pytest.mark.slow
def test_alignment_places_observations_several_times_as_well_and_says_how_well(room: Room, room_aligned: Poses) -> None:
    poses, aligned = room[0], room_aligned
    aligned.check()
    ranges = np.linalg.norm(poses.points_in_world[poses.track_point_idx] - poses.centers[poses.track_image_idx], axis=1)
    shown = shown_points(poses, ranges)
    before, after = (true_deviations_px(state, shown) for state in (poses, aligned))
    changed = np.any(aligned.track_bearings != poses.track_bearings, axis=1)
    assert changed.mean() > 0.3
    assert np.median(after[changed]) < 0.35 * np.median(before[changed])
    assert aligned.track_sigmas_rad is not None
    sigmas_px = aligned.track_sigmas_rad / PIXEL_RAD
    order = np.argsort(sigmas_px[changed])
    best, worst = (np.median(after[changed][part]) for part in np.array_split(order, 4)[::3])
    assert worst > 1.5 * best
    assert np.array_equal(aligned.points_in_world, poses.points_in_world)


def test_what_the_mask_ignores_is_not_aligned(room: Room, room_aligned: Poses) -> None:
    """Observations whose patches reach into a masked area keep their bearings; the others are aligned as before."""
    poses, pictures = room
    mask = np.ones(SIZE_HW, np.bool_)
    mask[:, 100:300] = False
    mask[:, :30] = False  # its border is the seam
    image, _ = pictures["1.png"]
    masked = align_tracks(poses, {**pictures, "1.png": (image, mask)}.__getitem__)
    column, _ = pixel_from_ray(poses.track_bearings, SIZE_HW).T
    in_masked_image = poses.track_image_idx == 1
    inside = in_masked_image & (((column > 98) & (column < 302)) | (column < 32) | (column > SIZE_HW[1] - 2))
    assert inside.sum() > 100
    assert np.array_equal(masked.track_bearings[inside], poses.track_bearings[inside])
    changed = np.any(room_aligned.track_bearings != poses.track_bearings, axis=1)
    assert changed[inside].sum() > 20
    far = in_masked_image & (column > 340) & (column < SIZE_HW[1] - 40)
    moved = np.any(masked.track_bearings != poses.track_bearings, axis=1)
    assert moved[far].sum() > 0.5 * changed[far].sum() > 10


def test_blocks_change_nothing(room: Room, room_aligned: Poses, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, pictures = room
    monkeypatch.setattr(alignment, "_AT_ONCE", 500)
    parts = align_tracks(poses, pictures.__getitem__)
    assert room_aligned.track_bearings.tobytes() == parts.track_bearings.tobytes()
    assert known(room_aligned.track_sigmas_rad).tobytes() == known(parts.track_sigmas_rad).tobytes()


def test_only_the_longest_tracks_are_aligned_where_there_are_many(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, pictures = room
    monkeypatch.setattr(alignment, "_MAX_PER_IMAGE", 300)
    cut = np.ones(6000, np.bool_)
    cut[: 4 * 1200 : 4] = False  # the first 1200 tracks have an observation less
    shorter = replace(
        poses,
        track_point_idx=poses.track_point_idx[cut],
        track_image_idx=poses.track_image_idx[cut],
        track_bearings=poses.track_bearings[cut],
    )
    aligned = align_tracks(shorter, pictures.__getitem__)
    changed = np.any(aligned.track_bearings != shorter.track_bearings, axis=1)
    assert shorter.track_point_idx[changed].min() >= 1200
    assert changed.sum() > 250


def test_poses_without_tracks_and_single_observations_stay(room: Room) -> None:
    poses, pictures = room
    nothing = Poses.without_points({"0.png": poses.cam_from_world(0)}, frame="x", scale="x", metric=False)
    assert align_tracks(nothing, pictures.__getitem__) is nothing
    one = poses.track_image_idx == 2
    alone = replace(
        poses,
        track_point_idx=poses.track_point_idx[one],
        track_image_idx=poses.track_image_idx[one],
        track_bearings=poses.track_bearings[one],
    )
    assert np.array_equal(align_tracks(alone, pictures.__getitem__).track_bearings, alone.track_bearings)


@pytest.mark.slow
def test_refinement_with_the_images_is_twice_as_good(room: Room) -> None:
    poses, pictures = room
    bent = replace(
        poses,
        rotations=rotation_from_rotvec(np.array([[0, 0, 0], [2, 1, 0], [0, -2, 1], [1, 0, 2]]) * 1e-3)
        @ poses.rotations,
    )
    plain, fine = refine_poses(bent), refine_poses(bent, load=pictures.__getitem__)

    def error(found: Poses) -> float:
        turns = np.einsum("nij,nkj->nik", found.rotations, poses.rotations)
        return float(np.sqrt(np.mean([np.linalg.norm(turn - turns[0] @ turns[0].T) ** 2 for turn in turns])))

    fine.check()
    assert fine.names == poses.names
    assert fine.track_sigmas_rad is not None
    assert error(fine) < 0.6 * error(plain)


def drawn_bundle(rng: np.random.Generator, *, points: int = 60, cameras: int = 4) -> tuple[Bundle, NDArray[np.float64]]:
    """A bundle whose observations have noise of very different size, and the sizes."""
    rotations = np.stack([random_rotation(rng) for _ in range(cameras)])
    centers = rng.uniform(-1, 1, (cameras, 3))
    places = rng.uniform(-4, 4, (points, 3))
    point_idx = np.repeat(np.arange(points, dtype=np.int32), cameras)
    image_idx = np.tile(np.arange(cameras, dtype=np.int32), points)
    sigmas = np.exp(rng.uniform(np.log(0.3), np.log(8), points * cameras))
    rays = np.einsum("tij,tj->ti", rotations[image_idx], places[point_idx] - centers[image_idx])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    noisy = rays + 5e-4 * sigmas[:, None] * rng.normal(size=rays.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    return Bundle(rotations, centers, places, point_idx, image_idx, noisy), sigmas


def rotation_error(found: Bundle, truth: Bundle) -> float:
    return float(np.sqrt(np.mean(np.sum((found.rotations - truth.rotations) ** 2, axis=(1, 2)))))


def test_weighted_adjustment_beats_the_unweighted_one() -> None:
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(12):
        bundle, sigmas = drawn_bundle(rng)
        # From the truth any step may look worse and be refused, whatever the weights.
        alike = adjust_bundle(bundle, RobustLoss("huber", 1.0))
        weighed = adjust_bundle(replace(alike, sigmas=sigmas), RobustLoss("huber", 1.0))
        errors.append([rotation_error(found, bundle) for found in (alike, weighed)])
    plain, weighted = np.mean(errors, axis=0)
    assert weighted < 0.7 * plain


def test_equal_sigmas_are_another_scale_of_the_loss() -> None:
    bundle, _ = drawn_bundle(np.random.default_rng(8))
    twice = replace(bundle, sigmas=np.full(len(bundle.point_idx), 2.0))
    first = adjust_bundle(bundle, RobustLoss("huber", 2e-3))
    second = adjust_bundle(twice, RobustLoss("huber", 1e-3))
    np.testing.assert_allclose(first.centers, second.centers, atol=1e-6)


@pytest.mark.parametrize("sigmas", [np.ones(3), np.zeros(240), np.full(240, np.nan)])
def test_a_bundle_refuses_impossible_sigmas(sigmas: NDArray[Any]) -> None:
    bundle, _ = drawn_bundle(np.random.default_rng(9))
    with pytest.raises(UsageError, match="one positive sigma for each observation"):
        replace(bundle, sigmas=sigmas).check()


@pytest.mark.slow
def test_groups_are_aligned_one_by_one(room: Room) -> None:
    poses, pictures = room
    others = {f"b{name}": picture for name, picture in pictures.items()}
    second = replace(poses, names=tuple(others))
    joined = align_tracks(join_groups([poses, second]), (pictures | others).__getitem__)
    alone = align_tracks(poses, pictures.__getitem__)
    for group in split_groups(joined):
        assert group.track_bearings.tobytes() == alone.track_bearings.tobytes()
        assert known(group.track_sigmas_rad).tobytes() == known(alone.track_sigmas_rad).tobytes()
