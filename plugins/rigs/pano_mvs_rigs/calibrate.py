"""From the pictures of a two-lens camera to its calibration.

1. circles     principal points and, with an assumed field of view, focal lengths of equidistant lenses
2. rims        matches between the rims of both lenses give the turn of the second lens and the field of view:
               opposite lenses see a point at angles from their axes that sum to 180°
3. rounds      matches between captures are verified with the lenses as known so far, which places the cameras;
               lenses, cameras and points are adjusted together; thresholds decrease from round to round
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.selection import spread_keypoints
from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.adjustment.tracks import Tracks, build_tracks, triangulate_observations
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.stitching import lens_panorama
from pano_mvs.algorithms.two_view.cheirality import agreement
from pano_mvs.algorithms.two_view.ransac import estimate_rotation
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import FisheyeLens, Rigid3, angle_between, rotation_from_rotvec
from pano_mvs.scene import Features, TwoView
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs_rigs.adjustment import (
    INTRINSICS,
    RIG,
    Freedom,
    RigBundle,
    adjust_rig,
    residuals_px,
)
from pano_mvs_rigs.circles import ImageCircle, brightest, find_circle

View = tuple[int, int]
"""Number of a capture, and of a lens: 0 or 1."""

# The edge of the circle is blurred: key points and the field of view end at this share of its radius.
USED_RADIUS = 0.985

_RIM_MIN, _RIM_THRESHOLD_DEG = 12, 1.5

# Maximum error of a match in each round, and whether the offset of the second lens is adjusted.
_ROUNDS = ((1.0, False), (0.3, True), (0.15, True))
_MIN_OBSERVATIONS = 300
_MAX_RAY_STD_DEG = 0.1


@dataclass(frozen=True, eq=False)
class Calibration:
    """The lenses of a camera, as found in a capture."""

    lenses: tuple[FisheyeLens, FisheyeLens]  # both lenses
    second_from_first: Rigid3  # pose of the second lens; the translation has length 1, or 0 if it is not determined
    offset_std: float  # standard deviation of the offset, relative to its length; NaN if it is not determined
    turn_std_deg: float  # standard deviation of the rotation about its least certain axis
    focal_std_px: tuple[float, float]  # of each lens
    principal_std_px: tuple[float, float]  # of each lens, in its less certain direction
    # (2,) standard deviation of the angle from the axis, the largest in the field that was observed
    ray_std_deg: tuple[float, float]
    observed_deg: tuple[float, float]  # angle from the axis within which 99 % of the observations of each lens lie
    residual_px: float  # median distance of an observation from the projection of its point
    captures: int  # number of captures with a pose
    observations: int  # number of observations
    circles: tuple[ImageCircle, ImageCircle]  # the image circle of each lens
    # matches between the rims of both lenses that determined the start values; 0 if too few were found
    rim_matches: int


@dataclass(frozen=True, eq=False)
class _Seen:
    """Key points of each view, their pixels in the picture of the lens, and matches between views."""

    features: Mapping[View, Features]
    pixels: Mapping[View, FloatArray]
    matches: Mapping[tuple[View, View], NDArray[np.int32]]
    count: int


@dataclass(frozen=True, eq=False)
class _State:
    """The lenses so far, and the poses of the captures in one of them, first_lens_from_world."""

    lenses: tuple[FisheyeLens, FisheyeLens]
    second_from_first: Rigid3
    cameras: Mapping[int, Rigid3]

    def rays(self, view: View, pixels: FloatArray) -> FloatArray:
        """Return the rays of pixels (K, 2) in the frame of the view's lens, (K, 3)."""
        return self.lenses[view[1]].ray_from_pixel(pixels)

    def pose(self, view: View) -> Rigid3:
        """Return lens_from_world of a view."""
        first = self.cameras[view[0]]
        return first if view[1] == 0 else self.second_from_first @ first


def calibrate_lenses(
    load: Callable[[View], Picture],
    count: int,
    *,
    field_of_view_deg: float,
    rng: np.random.Generator,
    progress: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Estimate both lenses of a camera, and the pose of the second in the first, from the pictures of a capture.

    Args:
        load: returns the picture of a view, (H, W, 3) uint8; all pictures of a lens have the same size.
        count: number of captures, from at least two places.
        field_of_view_deg: about the full angle of the image circles.
        rng: draws samples.
        progress: is called with each step.

    Raises:
        InputError: if the pictures do not determine the lenses; the message says why, and what to do.
    """
    progress("looking for the image circles")
    circles = tuple(_circle(load, lens, count) for lens in (0, 1))
    sizes = [load((0, lens)).shape[:2] for lens in (0, 1)]
    lenses = [
        _start_lens(circle, (size[0], size[1]), field_of_view_deg) for circle, size in zip(circles, sizes, strict=True)
    ]
    seen = _observed(load, count, lenses, progress=progress)
    starts, rim_matches = _start_rigs(seen, (lenses[0], lenses[1]), rng=rng)
    state = _placed(seen, starts, rng=rng, progress=progress)
    radii = [USED_RADIUS * circle.radius_px for circle in circles]
    centers = [circle.center_xy for circle in circles]
    bundle, covariance = None, np.zeros((RIG.stop, RIG.stop))
    for number, (threshold_deg, with_offset) in enumerate(_ROUNDS):
        if number == 1:
            state = _placed(seen, [state], rng=rng, threshold_deg=threshold_deg, progress=progress)
        progress(f"adjusting lenses and cameras, round {number + 1} of {len(_ROUNDS)}")
        bundle, covariance = _adjusted(
            seen, state, _freedom(state, centers, with_offset=with_offset), threshold_deg=threshold_deg
        )
        state = _state(bundle, state, radii)
    assert bundle is not None
    length = float(np.linalg.norm(bundle.offset))
    offset_std = np.nan
    if length > 0:
        offset_std = float(np.sqrt(np.linalg.eigvalsh(covariance[RIG, RIG][3:, 3:])[-1])) / length
    if length > 0 and not offset_std < 0.2:
        bundle, covariance = _adjusted(
            seen, state, _freedom(state, centers, with_offset=False), threshold_deg=2 * _ROUNDS[-1][0]
        )
        state, offset_std = _state(bundle, state, radii), np.nan
    return _calibration(
        bundle, covariance, state, circles=(circles[0], circles[1]), offset_std=offset_std, rim_matches=rim_matches
    )


def _circle(load: Callable[[View], Picture], lens: int, count: int) -> ImageCircle:
    circle = find_circle(brightest(load((capture, lens)) for capture in range(count)))
    if circle is None:
        raise InputError(
            f"the pictures of the {('first', 'second')[lens]} lens show no bright circle with a dark surround. Give "
            "the raw pictures of the camera, not stitched or cropped ones"
        )
    return circle


def _start_lens(circle: ImageCircle, size_hw: tuple[int, int], field_of_view_deg: float) -> FisheyeLens:
    half = float(np.radians(field_of_view_deg / 2))
    focal = circle.radius_px / half
    return FisheyeLens(size_hw, (focal, focal), circle.center_xy, (0.0, 0.0, 0.0, 0.0), USED_RADIUS * half)


def _observed(
    load: Callable[[View], Picture], count: int, lenses: Sequence[FisheyeLens], *, progress: Callable[[str], None]
) -> _Seen:
    """Return key points, found in panoramas of one lens each, and their matches."""
    features, pixels, matches = {}, {}, {}
    width = min(2560, round(2 * np.pi * max(lens.focal_xy[0] for lens in lenses)) // 4 * 4)
    for capture, lens_idx in product(range(count), (0, 1)):
        if lens_idx == 0:
            progress(f"finding key points, capture {capture + 1} of {count}")
        lens = lenses[lens_idx]
        panorama, valid = lens_panorama(load((capture, lens_idx)), lens, size_hw=(width // 2, width))
        found = extract_sift(panorama, valid, max_keypoints=6000)
        features[capture, lens_idx] = found
        pixels[capture, lens_idx] = lens.pixel_from_ray(found.bearings)
    # All key points are matched between the rims, some of them between captures.
    some = {
        view: spread_keypoints(found.bearings, found.scores, max_keypoints=2500) for view, found in features.items()
    }
    progress("matching key points")
    for first, second in combinations(features, 2):
        # The lenses of one capture share their rims only.
        chosen = [_rim(features[view]) if first[0] == second[0] else some[view] for view in (first, second)]
        one, other = (_part(features[view], places) for view, places in zip((first, second), chosen, strict=True))
        found_at = match_features(one, other)
        matches[first, second] = np.stack(
            [places[found_at[:, idx]] for idx, places in enumerate(chosen)], axis=1
        ).astype(np.int32)
    return _Seen(features, pixels, matches, count)


def _rim(features: Features) -> NDArray[np.intp]:
    return np.flatnonzero(features.bearings[:, 2] < np.cos(np.radians(75.0)))


def _part(features: Features, chosen: NDArray[np.intp]) -> Features:
    names = ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
    return replace(features, **{name: getattr(features, name)[chosen] for name in names})


def _start_rigs(
    seen: _Seen, lenses: tuple[FisheyeLens, FisheyeLens], *, rng: np.random.Generator
) -> tuple[list[_State], int]:
    """Return the start values to try, and the number of matches between rims behind them.

    Without enough matches between the rims, the second lens may have any of four turns about its axis.
    """
    halfway = rotation_from_rotvec(np.array([0.0, np.pi, 0.0]))
    p, q = (
        np.concatenate(
            [
                seen.features[capture, lens].bearings[seen.matches[(capture, 0), (capture, 1)][:, lens]]
                for capture in range(seen.count)
            ]
        )
        for lens in (0, 1)
    )
    best_rotation, best_scale, best = np.eye(3), 1.0, np.zeros(len(p), np.bool_)
    for scale in np.arange(0.85, 1.151, 0.01) if len(p) >= _RIM_MIN else ():
        rotation, inliers = estimate_rotation(
            _scaled(p, scale), _scaled(q, scale), rng=rng, threshold_rad=float(np.radians(_RIM_THRESHOLD_DEG))
        )
        tilt = np.degrees(np.arccos(np.clip(-rotation[2, 2], -1, 1)))
        if tilt < 15.0 and inliers.sum() > best.sum():
            best_rotation, best_scale, best = rotation, float(scale), inliers
    if best.sum() >= _RIM_MIN:
        # Opposite lenses see a point at angles from their axes that sum to 180°; a tilt cancels over the circumference.
        angles = np.arccos(np.clip(np.stack([p[best, 2], q[best, 2]]), -1, 1))
        best_scale = float(np.pi / np.median(angles.sum(axis=0)))
        known = _rescaled(lenses, best_scale)
        return [_State(known, Rigid3(best_rotation, np.zeros(3)), {})], int(best.sum())
    turns = [rotation_from_rotvec(np.array([0.0, 0.0, quarter * np.pi / 2])) for quarter in range(4)]
    return [_State(lenses, Rigid3(turn @ halfway, np.zeros(3)), {}) for turn in turns], 0


def _scaled(bearings: FloatArray, scale: float) -> FloatArray:
    """Return bearings (M, 3) whose angles from the axis are multiplied."""
    angles = scale * np.arccos(np.clip(bearings[:, 2], -1, 1))
    plane = bearings[:, :2] / np.maximum(np.hypot(*bearings[:, :2].T), 1e-12)[:, None]
    return np.concatenate([np.sin(angles)[:, None] * plane, np.cos(angles)[:, None]], axis=1)


def _rescaled(lenses: tuple[FisheyeLens, FisheyeLens], scale: float) -> tuple[FisheyeLens, FisheyeLens]:
    first, second = (
        replace(
            lens,
            focal_xy=(lens.focal_xy[0] / scale, lens.focal_xy[1] / scale),
            max_angle_rad=min(scale * lens.max_angle_rad, np.pi),
        )
        for lens in lenses
    )
    return first, second


def _placed(
    seen: _Seen,
    starts: Sequence[_State],
    *,
    rng: np.random.Generator,
    threshold_deg: float = _ROUNDS[0][0],
    progress: Callable[[str], None],
) -> _State:
    """Return the start with most verified matches, and the cameras as these place them."""
    tried = []
    for start in starts:
        progress("verifying matches between captures")
        features = {str(capture): _capture_features(seen, start, capture) for capture in range(seen.count)}
        pairs = {
            (str(first), str(second)): verify_pair(
                features[str(first)],
                features[str(second)],
                _capture_matches(seen, first, second),
                rng=rng,
                threshold_deg=threshold_deg,
            )
            for first, second in combinations(range(seen.count), 2)
        }
        tried.append((sum(map(len, pairs.values())), start, features, pairs))
    _, start, features, pairs = max(tried, key=lambda one: one[0])
    poses = solve_scaled_translation(features, pairs, rng=rng)
    if not poses.names:
        raise _not_connected(pairs)
    group = split_groups(poses)[0]
    cameras = {
        int(name): Rigid3(rotation, translation)
        for name, rotation, translation in zip(group.names, group.rotations, group.translations, strict=True)
    }
    return replace(start, cameras=cameras)


def _not_connected(pairs: Mapping[tuple[str, str], TwoView]) -> InputError:
    if any(view.geometry == "rotation" for view in pairs.values()):
        return InputError(
            "all pictures were taken from the same place, which does not determine the lenses. Give pictures from two "
            "or more places, half a metre or more apart"
        )
    reasons = "; ".join(sorted({view.reason for view in pairs.values() if view.reason})[:2])
    return InputError(
        f"the pictures could not be connected with each other ({reasons}). Give 6 to 12 pictures of one place with "
        "texture, taken half a metre to a metre apart, with the camera turned between them"
    )


def _capture_features(seen: _Seen, state: _State, capture: int) -> Features:
    """Return the key points of both lenses in the frame of the first."""
    views = [(capture, lens) for lens in (0, 1)]
    rays = [state.rays(view, seen.pixels[view]) for view in views]
    rays[1] = rays[1] @ state.second_from_first.rotation
    # Beyond the field of view as it is known now, any direction will do: `_agreeing` drops these matches.
    bearings = np.nan_to_num(np.concatenate(rays), nan=1 / np.sqrt(3))
    features = [seen.features[view] for view in views]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in features])
        for name in ("descriptors", "sizes_rad", "scores", "colors_rgb")
    }
    return replace(features[0], bearings=bearings / np.linalg.norm(bearings, axis=1, keepdims=True), **joined)


def _capture_matches(seen: _Seen, first: int, second: int) -> NDArray[np.int32]:
    """Return the matches of two captures as key points of `_capture_features`."""
    joined = [
        seen.matches[(first, a), (second, b)]
        + np.array([a * len(seen.features[first, 0]), b * len(seen.features[second, 0])])
        for a, b in product((0, 1), (0, 1))
    ]
    return np.concatenate(joined).astype(np.int32)


def _agreeing(seen: _Seen, state: _State, *, threshold_deg: float) -> dict[tuple[str, str], TwoView]:
    """Return the matches between placed views that agree with their poses."""
    pairs = {}
    rays = {view: state.rays(view, seen.pixels[view]) for view in seen.features if view[0] in state.cameras}
    threshold = float(np.radians(threshold_deg))
    for (first, second), matches in seen.matches.items():
        if first not in rays or second not in rays:
            continue
        p, q = rays[first][matches[:, 0]], rays[second][matches[:, 1]]
        known = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
        matches, p, q = matches[known], p[known], q[known]
        pose = state.pose(second) @ state.pose(first).inverse()
        length = float(np.linalg.norm(pose.translation))
        if length > 0:
            errors, agree = agreement(Rigid3(pose.rotation, pose.translation / length), p, q, threshold_rad=threshold)
        else:
            errors = angle_between(p @ pose.rotation.T, q)
            agree = errors < (np.radians(_RIM_THRESHOLD_DEG) if first[0] == second[0] else 1.5 * threshold)
        pairs[_name(first), _name(second)] = TwoView(
            matches[agree], np.eye(3), np.zeros(3), errors[agree].astype(np.float32), "general"
        )
    return pairs


def _name(view: View) -> str:
    return f"{view[0]}:{view[1]}"


def _adjusted(seen: _Seen, state: _State, freedom: Freedom, *, threshold_deg: float) -> tuple[RigBundle, FloatArray]:
    """Return adjusted lenses and cameras, and the covariance of lenses and rig."""
    views = [view for view in seen.features if view[0] in state.cameras]
    tracks = build_tracks(
        {_name(view): seen.features[view] for view in views}, _agreeing(seen, state, threshold_deg=threshold_deg)
    )
    bundle = _bundle(seen, state, tracks, views=views, max_error_deg=1.5 * threshold_deg)
    if len(bundle.pixels) < _MIN_OBSERVATIONS:
        raise InputError(
            f"only {len(bundle.pixels)} observations of common points were found, {_MIN_OBSERVATIONS} are needed. Give "
            "more pictures of a place with texture, taken half a metre to a metre apart"
        )
    pixel_deg = float(np.degrees(1 / state.lenses[0].focal_xy[0]))
    covariance = np.zeros((RIG.stop, RIG.stop))
    for factor in (2.0, 1.0):
        scale = max(factor * float(np.median(residuals_px(bundle))), 0.05)
        bundle, covariance = adjust_rig(bundle, freedom, scale_px=scale)
        errors = residuals_px(bundle)
        limit = max(5 * float(np.median(errors)), 0.2 * threshold_deg / pixel_deg)
        bundle = bundle.only(errors < limit)
    return bundle, covariance


def _bundle(seen: _Seen, state: _State, tracks: Tracks, *, views: Sequence[View], max_error_deg: float) -> RigBundle:
    """Return the triangulated tracks; the world is the first lens of the first capture with a pose."""
    order = sorted(state.cameras)
    world = state.cameras[order[0]]
    poses = [state.cameras[capture] @ world.inverse() for capture in order]
    moved = replace(state, cameras=dict(zip(order, poses, strict=True)))
    lens_from_world = [moved.pose(view) for view in views]
    pixels = np.empty((len(tracks.track_idx), 2))
    for number, view in enumerate(views):
        here = tracks.image_idx == number
        pixels[here] = seen.pixels[view][tracks.keypoint_idx[here]]
    lens_idx = np.array([view[1] for view in views])[tracks.image_idx]
    rays = np.where(
        lens_idx[:, None] == 0, state.lenses[0].ray_from_pixel(pixels), state.lenses[1].ray_from_pixel(pixels)
    )
    rotations = np.array([pose.rotation for pose in lens_from_world])
    in_world = np.einsum("nji,nj->ni", rotations[tracks.image_idx], rays)
    found = triangulate_observations(
        np.array([pose.center for pose in lens_from_world])[tracks.image_idx],
        in_world,
        tracks.track_idx,
        count=tracks.count,
        max_error_rad=float(np.radians(max_error_deg)),
        min_angle_rad=float(np.radians(1.0)),
    )
    order_idx = {capture: idx for idx, capture in enumerate(order)}
    bundle = RigBundle(
        lenses=np.array([[lens.focal_xy[0], *lens.principal_xy, *lens.distortion] for lens in state.lenses]),
        turn=state.second_from_first.rotation,
        offset=state.second_from_first.translation,
        rotations=np.array([pose.rotation for pose in poses]),
        translations=np.array([pose.translation for pose in poses]),
        points=found.points_in_world,
        pixels=pixels,
        lens_idx=lens_idx.astype(np.intp),
        camera_idx=np.array([order_idx[view[0]] for view in views], np.intp)[tracks.image_idx],
        point_idx=tracks.track_idx.astype(np.intp),
    )
    return bundle.only(found.used & _some_points(found.valid)[tracks.track_idx])


def _some_points(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return points at equal steps of their numbers, at most 2500 of the valid ones."""
    chosen = np.flatnonzero(valid)
    if len(chosen) > 2500:
        chosen = chosen[np.linspace(0, len(chosen) - 1, 2500).astype(np.intp)]
    some = np.zeros(len(valid), np.bool_)
    some[chosen] = True
    return some


def _freedom(state: _State, centers: Sequence[tuple[float, float]], *, with_offset: bool) -> Freedom:
    start, sigmas = [], []
    for lens, center in zip(state.lenses, centers, strict=True):
        focal = lens.focal_xy[0]
        start += [focal, *center, 0.0, 0.0, 0.0, 0.0]
        # Lenses differ from equidistant ones, and circles from their axes, by about this much.
        sigmas += [0.2 * focal, *(0.05 * focal,) * 2, 0.1, 0.05, 0.02, 0.005]
    offset_sigma = np.inf if with_offset else 0.0
    turn_sigma = float(np.radians(10))
    return Freedom(np.array([*sigmas, *(turn_sigma,) * 3, *(offset_sigma,) * 3]), np.array([*start, *np.zeros(6)]))


def _state(bundle: RigBundle, state: _State, radii: Sequence[float]) -> _State:
    lenses = [
        _lens(values, lens.size_hw, radius)
        for values, lens, radius in zip(bundle.lenses, state.lenses, radii, strict=True)
    ]
    cameras = {
        capture: Rigid3(rotation, translation)
        for capture, rotation, translation in zip(
            sorted(state.cameras), bundle.rotations, bundle.translations, strict=True
        )
    }
    return _State((lenses[0], lenses[1]), Rigid3(bundle.turn, bundle.offset), cameras)


def _lens(values: FloatArray, size_hw: tuple[int, int], radius_px: float) -> FisheyeLens:
    """Return a lens whose field of view ends at a radius, or where its radius stops growing."""
    focal, x, y, *distortion = (float(value) for value in values)
    k1, k2, k3, k4 = distortion
    try:
        tiny = FisheyeLens(size_hw, (focal, focal), (x, y), (k1, k2, k3, k4), 1e-3)
    except UsageError as error:
        raise InputError(
            f"the lenses could not be determined ({error}). Give more pictures, of a place with texture"
        ) from error
    limit = min(0.999 * tiny.monotonic_limit_rad, 0.999 * np.pi)
    reach = float(replace(tiny, max_angle_rad=limit).angle_from_radius(radius_px / focal))
    return replace(tiny, max_angle_rad=limit if np.isnan(reach) else reach)


def _calibration(
    bundle: RigBundle,
    covariance: FloatArray,
    state: _State,
    *,
    circles: tuple[ImageCircle, ImageCircle],
    offset_std: float,
    rim_matches: int,
) -> Calibration:
    stds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    length = float(np.linalg.norm(bundle.offset))
    rays, observed = [], []
    for idx, lens in enumerate(state.lenses):
        seen = bundle.pixels[bundle.lens_idx == idx]
        angles = lens.angle_from_axis(lens.ray_from_pixel(seen))
        observed.append(float(np.nanpercentile(angles, 99)) if len(seen) else 0.0)
        rays.append(_ray_std_deg(lens, covariance[INTRINSICS * idx :, INTRINSICS * idx :], observed[-1]))
    found = Calibration(
        lenses=state.lenses,
        second_from_first=Rigid3(bundle.turn, bundle.offset / length if np.isfinite(offset_std) else np.zeros(3)),
        offset_std=offset_std,
        turn_std_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[RIG, RIG][:3, :3])[-1]))),
        focal_std_px=(float(stds[0]), float(stds[INTRINSICS])),
        principal_std_px=(float(stds[1:3].max()), float(stds[INTRINSICS + 1 : INTRINSICS + 3].max())),
        ray_std_deg=(rays[0], rays[1]),
        observed_deg=(float(np.degrees(observed[0])), float(np.degrees(observed[1]))),
        residual_px=float(np.median(residuals_px(bundle))),
        captures=len(bundle.rotations),
        observations=len(bundle.pixels),
        circles=circles,
        rim_matches=rim_matches,
    )
    if not max(found.ray_std_deg) < _MAX_RAY_STD_DEG:
        raise InputError(
            f"the lenses are not determined: rays would be uncertain by {max(found.ray_std_deg):.2f}°, at most "
            f"{_MAX_RAY_STD_DEG}° are useful. Give more pictures, taken half a metre to a metre apart, with the camera "
            "turned between them"
        )
    return found


def _ray_std_deg(lens: FisheyeLens, covariance: FloatArray, reach_rad: float) -> float:
    """Return the largest standard deviation of the angle from the axis within a reach."""
    angles = np.linspace(0.05, 1.0, 20) * reach_rad
    focal = lens.focal_xy[0]
    by = np.stack(
        [lens.radius_from_angle(angles), *(focal * angles**power for power in (3, 5, 7, 9))], axis=1
    )  # of the radius in pixels by f and k1 … k4
    chosen = [0, *range(3, INTRINSICS)]
    variance = np.einsum("ni,ij,nj->n", by, covariance[np.ix_(chosen, chosen)], by)
    return float(np.degrees(np.sqrt(np.maximum(variance, 0.0)) / (focal * lens.radius_slope(angles))).max())
