"""Localise ordinary photographs among panoramas: the pose and the focal length from key points with ranges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.tangent import PhotographKeypoints
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.algorithms.poses.colmap.mapping import colmap_seed
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, geodesic_angle
from pano_mvs_photographs.alignment import Aligned, PhotographPatches
from pano_mvs_photographs.camera import FocalPrior, PhotographCamera, refine_camera
from pano_mvs_photographs.panoramas import KnownPoints

_FOV_BOUNDS_DEG = (15.0, 120.0)
_FEW = 8
_MIN_ALIGNED = 40  # patches that refine a pose


class Localised(NamedTuple):
    """A photograph's pose and camera (see `Photographs`)."""

    cam_from_world: Rigid3  # the pose
    focal_px: float  # focal length
    radial: float  # coefficient of the distortion
    inliers: int  # number of key points that agree
    error_px: float  # median error of these


@checks_settings
def localise_photograph(
    keypoints: PhotographKeypoints,
    size_hw: tuple[int, int],
    panoramas: Mapping[str, KnownPoints],
    *,
    focal_px: float | None,
    patches: PhotographPatches | None = None,
    learned: Mapping[str, NDArray[np.int32]] | None = None,
    min_inliers: Annotated[int, Setting("minimum number of key points that agree with the pose", ge=6)] = 30,
    max_error_deg: Annotated[float, Setting("maximum error of a key point that agrees", gt=0, le=5)] = 0.4,
    rng: np.random.Generator,
) -> Localised | str:
    """Estimate the pose and the focal length of a photograph, or return the reason why that is not possible.

    Its key points are matched with those of the panoramas. LO-RANSAC finds the pose, with the focal length
    unless it is known (as implemented by COLMAP). Pose, focal length and one coefficient of radial distortion are then
    refined, with more matches, which are looked for near the places that the pose predicts, and with patches of the
    panoramas. If the key points alone are too few, the patches decide: also between the poses that single panoramas
    suggest.

    Args:
        keypoints: of the photograph.
        size_hw: (height, width) of the photograph.
        panoramas: key points with positions, by name.
        focal_px: focal length if it is known, None otherwise.
        patches: the photograph and the panoramas, to align patches; None: key points only.
        learned: by panorama, matches (M, 2) that a network found: positions in `keypoints` and in the known points.
        rng: gives RANSAC's seed.
    """
    if patches is not None and patches.too_narrow:
        return f"it is {size_hw[1]} × {size_hw[0]} pixels, which is too narrow to be compared with panoramas"
    by_network = learned or {}
    each = {name: _matches(keypoints, known, learned=by_network.get(name)) for name, known in panoramas.items()}
    matches = _joined(each.values())
    if len(matches.pixels_px) < (min_inliers if patches is None else _FEW):
        return (
            f"only {len(matches.pixels_px)} of its {len(keypoints.pixels_px)} key points match points of the panoramas"
        )
    if focal_px is None:
        # Without a focal length in the file, a picture is taken to be as wide as most phones' for the first guess.
        prior = FocalPrior(max(size_hw) / 2 / float(np.tan(np.radians(65.0) / 2)), 0.4)
    else:
        prior = FocalPrior(focal_px, 0.1)
    search = _Search(
        keypoints=keypoints,
        size_hw=size_hw,
        panoramas=panoramas,
        prior=prior,
        focal_known=focal_px is not None,
        patches=patches,
        min_inliers=min_inliers,
        max_error=float(np.radians(max_error_deg)),
    )
    found = search.located(matches, seed=colmap_seed(rng))
    if isinstance(found, Localised | _Cropped) or patches is None:
        return found
    most = sorted(panoramas, key=lambda name: -len(each[name].pixels_px))[:5]
    singly = [_matches(keypoints, panoramas[name], ratio=0.9, learned=by_network.get(name)) for name in most]
    return search.confirmed([matches, *(one for one in singly if len(one.pixels_px) >= _FEW)], rng) or found


class _Matches(NamedTuple):
    """Pixels (M, 2) of key points, and the points (M, 3) that they show."""

    pixels_px: FloatArray
    points_in_world: FloatArray


def _joined(matches: Iterable[_Matches]) -> _Matches:
    each = list(matches)
    return _Matches(
        np.concatenate([np.zeros((0, 2)), *(one.pixels_px for one in each)]),
        np.concatenate([np.zeros((0, 3)), *(one.points_in_world for one in each)]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What is known about one photograph while its camera is looked for; see `localise_photograph`."""

    keypoints: PhotographKeypoints
    size_hw: tuple[int, int]
    panoramas: Mapping[str, KnownPoints]
    prior: FocalPrior
    focal_known: bool
    patches: PhotographPatches | None
    min_inliers: int
    max_error: float

    def located(self, matches: _Matches, *, seed: int) -> Localised | str:
        """Return the camera by the agreement of key points, or the reason why there is none."""
        count = len(matches.pixels_px)
        if count < self.min_inliers:
            return f"only {count} of its {len(self.keypoints.pixels_px)} key points match points of the panoramas"
        first = self.first(matches, seed=seed)
        if first is None:
            return f"no pose agrees with its {count} matches"
        camera = self.refined(matches, first)
        # Guided matches confirm any pose to some degree, so these have to be enough without them.
        inliers = self.agreeing(matches, camera)
        if reason := _implausible(
            inliers.pixels_px, self.size_hw, camera=camera, matches=count, min_inliers=self.min_inliers
        ):
            return reason
        agreeing, names, camera = self.guided(matches, camera)
        if reason := _implausible(
            agreeing.pixels_px,
            self.size_hw,
            camera=camera,
            matches=len(agreeing.pixels_px),
            min_inliers=self.min_inliers,
        ):
            return reason
        if self.patches is not None:
            aligned = self.patches.aligned(camera, names, prior=self.prior)
            if aligned.confirmed >= _MIN_ALIGNED and (reason := _cropped(aligned)):
                return reason
            if aligned.confirmed >= _MIN_ALIGNED and self._close(camera, aligned.camera):
                camera = aligned.camera
        return self.localised(camera, agreeing)

    def confirmed(self, candidates: Sequence[_Matches], rng: np.random.Generator) -> Localised | str:
        """Return the camera that patches confirm best among those that few key points suggest.

        The reason if that photograph was cropped; "" if no camera is sure.
        """
        assert self.patches is not None
        best: tuple[Aligned, _Matches] | None = None
        for matches in candidates:
            first = self.first(matches, seed=colmap_seed(rng))
            if first is None:
                continue
            camera = self.refined(matches, first)
            agreeing, names, camera = self.guided(self.agreeing(matches, camera), camera)
            if len(np.unique(agreeing.pixels_px, axis=0)) < _FEW:
                continue
            aligned = self.patches.aligned(camera, names, prior=self.prior)
            if best is None or aligned.confirmed > best[0].confirmed:
                best = aligned, agreeing
        # The patches of the panoramas must confirm it: this many, and this share of those that the photograph shows.
        if best is None or best[0].confirmed < 60 or best[0].share < 0.3:
            return ""
        aligned, _ = best
        if reason := _cropped(aligned):
            return reason
        matches, _, _ = self.guided(_joined([]), aligned.camera)
        agreeing = self.agreeing(matches, aligned.camera)
        distinct = len(np.unique(agreeing.pixels_px, axis=0))
        if distinct < _FEW or _implausible(
            agreeing.pixels_px, self.size_hw, camera=aligned.camera, matches=len(agreeing.pixels_px), min_inliers=_FEW
        ):
            return ""
        return self.localised(aligned.camera, agreeing)

    def first(self, matches: _Matches, *, seed: int) -> PhotographCamera | None:
        """Return the camera that LO-RANSAC finds."""
        import pycolmap

        height, width = self.size_hw
        params = [self.prior.focal_px, width / 2, height / 2, 0.0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
        estimation = pycolmap.AbsolutePoseEstimationOptions()
        estimation.estimate_focal_length = not self.focal_known
        estimation.ransac.max_error = self.prior.focal_px * self.max_error
        estimation.ransac.random_seed = seed
        found = pycolmap.estimate_absolute_pose(matches.pixels_px, matches.points_in_world, camera, estimation)
        if found is None:
            return None
        pose = found["cam_from_world"]
        cam_from_world = Rigid3(pose.rotation.matrix(), np.array(pose.translation))
        return PhotographCamera(cam_from_world, float(camera.params[0]), 0.0)

    def refined(self, matches: _Matches, camera: PhotographCamera) -> PhotographCamera:
        """Return the camera with the smallest errors of its inliers."""
        return refine_camera(*matches, camera, size_hw=self.size_hw, prior=self.prior, max_error=self.max_error)

    def agreeing(self, matches: _Matches, camera: PhotographCamera) -> _Matches:
        """Return the inliers of a camera."""
        inliers = camera.errors(*matches, self.size_hw) < camera.focal_px * self.max_error
        return _Matches(matches.pixels_px[inliers], matches.points_in_world[inliers])

    def guided(self, matches: _Matches, camera: PhotographCamera) -> tuple[_Matches, list[str], PhotographCamera]:
        """Return matches near the places that a camera predicts, the panoramas with most of them, and the camera."""
        names: list[str] = []
        for _ in range(2):
            each = {
                name: _guided_matches(self.keypoints, known, camera, size_hw=self.size_hw, max_error=2 * self.max_error)
                for name, known in self.panoramas.items()
            }
            matches = _joined([matches, *each.values()])
            camera = self.refined(matches, camera)
            matches = self.agreeing(matches, camera)
            counts = {name: len(self.agreeing(found, camera).pixels_px) for name, found in each.items()}
            names = sorted((name for name in each if counts[name]), key=lambda name: -counts[name])
        return matches, names[:8], camera

    def localised(self, camera: PhotographCamera, matches: _Matches) -> Localised:
        """Return the result for a camera and the matches that agree with it."""
        errors = camera.errors(*matches, self.size_hw)
        return Localised(
            camera.cam_from_world,
            camera.focal_px,
            camera.radial,
            inliers=len(np.unique(matches.pixels_px, axis=0)),
            error_px=float(np.median(errors)),
        )

    def _close(self, camera: PhotographCamera, aligned: PhotographCamera) -> bool:
        """Return whether patches left the camera about where key points had put it."""
        turn = geodesic_angle(camera.cam_from_world.rotation, aligned.cam_from_world.rotation)
        return bool(turn < np.radians(2.0)) and _FOV_BOUNDS_DEG[0] < aligned.fov_deg(self.size_hw) < _FOV_BOUNDS_DEG[1]


def _matches(
    keypoints: PhotographKeypoints,
    known: KnownPoints,
    *,
    ratio: float = 0.8,
    learned: NDArray[np.int32] | None = None,
) -> _Matches:
    """Return the matches of a photograph with one panorama, with those that a network found."""
    if min(len(keypoints.descriptors), len(known.descriptors)) < 2:
        return _joined([])
    matched = match_l2(keypoints.descriptors, known.descriptors, ratio=ratio)
    if learned is not None:
        matched = np.unique(np.concatenate([matched, learned]), axis=0)
    return _Matches(keypoints.pixels_px[matched[:, 0]], known.points_in_world[matched[:, 1]])


def _guided_matches(
    keypoints: PhotographKeypoints,
    known: KnownPoints,
    camera: PhotographCamera,
    *,
    size_hw: tuple[int, int],
    max_error: float,
) -> _Matches:
    """Match each known point with the most similar of the key points near its place in the photograph.

    These are many more matches than those without a pose, because only key points nearby compete.
    """
    from scipy.spatial import cKDTree

    seen, before = camera.project(known.points_in_world, size_hw)
    inside = np.flatnonzero(before & ((seen >= 0) & (seen < size_hw[::-1])).all(axis=1))
    chosen: dict[int, tuple[float, int]] = {}
    if len(inside) and len(keypoints.pixels_px):
        tree = cKDTree(keypoints.pixels_px)
        for idx in inside.tolist():
            nearby = tree.query_ball_point(seen[idx], camera.focal_px * max_error, return_sorted=True)
            distance, key = _most_similar(keypoints.descriptors, nearby, known.descriptors[idx].astype(np.float32))
            if distance < chosen.get(key, (300.0, 0))[0]:
                chosen[key] = distance, idx
    return _Matches(
        keypoints.pixels_px[list(chosen)].reshape(-1, 2),
        known.points_in_world[[idx for _, idx in chosen.values()]].reshape(-1, 3),
    )


def _most_similar(
    descriptors: NDArray[np.float32], candidates: list[int], wanted: NDArray[np.float32]
) -> tuple[float, int]:
    """Return the distance and the position of the most similar candidate; an infinite distance if it is ambiguous."""
    if not candidates:
        return np.inf, -1
    distances = np.linalg.norm(descriptors[candidates] - wanted, axis=1)
    best = int(distances.argmin())
    if len(distances) > 1 and distances[best] > 0.9 * np.partition(distances, 1)[1]:
        return np.inf, -1
    return float(distances[best]), candidates[best]


class _Cropped(str):
    """Why a photograph is taken to be cropped, which other poses would not change."""

    __slots__ = ()


def _cropped(aligned: Aligned) -> _Cropped:
    """Return why a photograph is taken to be cropped, "" if it is not."""
    # A photograph whose optical centre is further from its middle, as a share of the longer side, was cropped.
    if aligned.off_center <= 0.02:
        return _Cropped()
    return _Cropped(
        f"it seems to be cropped: its optical centre is {100 * aligned.off_center:.0f} % of its longer side away from "
        "its middle. Give it as the camera stored it"
    )


def _implausible(
    inliers_px: FloatArray, size_hw: tuple[int, int], *, camera: PhotographCamera, matches: int, min_inliers: int
) -> str:
    """Return why a pose cannot be trusted, "" if it can."""
    # A key point that matches the same place in several panoramas counts once.
    distinct = len(np.unique(inliers_px, axis=0))
    if distinct < min_inliers or len(inliers_px) < 0.15 * matches:
        return f"only {len(inliers_px)} of its {matches} matches, of {distinct} key points, agree with one pose"
    fov_deg = camera.fov_deg(size_hw)
    if not _FOV_BOUNDS_DEG[0] <= fov_deg <= _FOV_BOUNDS_DEG[1] or abs(camera.radial) > 0.5:
        return f"its matches give an implausible camera: {fov_deg:.0f}° wide, distortion {camera.radial:.2f}"
    spread = np.linalg.svd(inliers_px - inliers_px.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(inliers_px))
    # The standard deviation of the pixels, as a share of the diagonal.
    if spread < 0.05 * np.hypot(*size_hw):
        return "its matches lie on a line or in one spot, which does not determine a pose"
    return ""
