"""A model that grows by one image at a time: its cameras, its points, and the decision on every new image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.points import Triangulated, triangulate_observations
from pano_mvs.algorithms.poses.adjustment.tracks import Tracks
from pano_mvs.algorithms.poses.placement.pair_evidence import MIN_RATIOS, ScaleEstimator, estimate_scale, unit_ranges
from pano_mvs.algorithms.poses.placement.resection import (
    FIRST_GUESS_RAD,
    MAX_ERROR_RAD,
    MIN_POINTS,
    points_needed,
    refined_on_points,
    resection_errors,
    why_few_known,
    why_few_seen,
)
from pano_mvs.algorithms.poses.placement.view_graph import Edge, relative_pose
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import TwoView


@dataclass(frozen=True, eq=False)
class Attachment:
    """The pose of an image relative to the current model; falsy, with the reason, if it is not reliable."""

    cam_from_world: Rigid3  # the pose
    support: int = 0  # number of known points that it sees where they should be
    known: int = 0  # number of known points that its tracks contain
    reason: str = ""  # why the pose is not reliable

    def __bool__(self) -> bool:
        """Return whether the image may be added."""
        return not self.reason


@dataclass(eq=False)
class GrowingModel:
    """Registered cameras and triangulated tracks; the world frame is the first camera of the seed pair."""

    tracks: Tracks  # all tracks of the capture
    edges: Mapping[Edge, TwoView]  # verified pairs by positions of images
    estimator: ScaleEstimator  # how translation scale factors are estimated from the ratios of single features
    kappa: float  # the paper's κ
    cameras: dict[int, Rigid3] = field(default_factory=dict)  # image position to cam_from_world

    def __post_init__(self) -> None:
        self.points_in_world = np.full((self.tracks.count, 3), np.nan)  # of all tracks, NaN where not triangulated
        # Positions of the observations of every image, and its pairs, sorted by number of verified matches.
        by_image = np.argsort(self.tracks.image_idx, kind="stable")
        sizes = np.bincount(self.tracks.image_idx, minlength=len(self.tracks.names))
        self._track_of_image = np.split(by_image, np.cumsum(sizes)[:-1])
        self._pairs: list[list[tuple[int, int]]] = [[] for _ in self.tracks.names]
        for (first, second), view in self.edges.items():
            self._pairs[first].append((-len(view), second))
            self._pairs[second].append((-len(view), first))
        for pairs in self._pairs:
            pairs.sort()

    def add(self, image: int, cam_from_world: Rigid3) -> None:
        """Register an image and triangulate the tracks that it sees."""
        self.cameras[image] = cam_from_world
        self.triangulate(self.tracks.track_idx[self._track_of_image[image]])

    def triangulate(self, track_idx: NDArray[np.int32] | None = None) -> tuple[NDArray[np.intp], Triangulated]:
        """Triangulate some tracks, or all, from all registered cameras.

        Returns:
            The positions of the observations that were used, and the triangulated points.
        """
        tracks = self.tracks
        chosen = np.ones(tracks.count, np.bool_)
        if track_idx is not None:
            chosen = np.zeros(tracks.count, np.bool_)
            chosen[track_idx] = True
        registered = np.zeros(len(tracks.names), np.bool_)
        registered[list(self.cameras)] = True
        seen = np.flatnonzero(chosen[tracks.track_idx] & registered[tracks.image_idx])
        compact = np.cumsum(chosen) - 1
        rotations, centers = self._arrays()
        found = triangulate_observations(
            centers[tracks.image_idx[seen]],
            np.einsum("nji,nj->ni", rotations[tracks.image_idx[seen]], tracks.bearings[seen]),
            compact[tracks.track_idx[seen]].astype(np.int32),
            count=int(chosen.sum()),
            max_error_rad=MAX_ERROR_RAD,
            min_angle_rad=float(np.deg2rad(1.0)),
        )
        self.points_in_world[chosen] = found.points_in_world
        return seen, found

    def adjust(self) -> None:
        """Refine all cameras except the first together with the points (bundle adjustment), and triangulate again."""
        seen, found = self.triangulate()
        used = seen[found.used]
        images = sorted(self.cameras)
        position = np.zeros(len(self.tracks.names), np.int32)
        position[images] = np.arange(len(images))
        rotations, centers = self._arrays()
        bundle = Bundle(
            rotations=rotations[images],
            centers=centers[images],
            points=found.points_in_world[found.valid],
            point_idx=(np.cumsum(found.valid) - 1)[self.tracks.track_idx[used]].astype(np.int32),
            image_idx=position[self.tracks.image_idx[used]],
            bearings=self.tracks.bearings[used],
        )
        bundle = adjust_bundle(
            bundle,
            loss="cauchy",
            scale_rad=MAX_ERROR_RAD / 4,
            max_iterations=20,
            tolerance=1e-3,  # the finished model is refined anyway
            fixed_camera=images.index(next(iter(self.cameras))),
        )
        for image, rotation, center in zip(images, bundle.rotations, bundle.centers, strict=True):
            self.cameras[image] = Rigid3.from_center(rotation, center)
        self.triangulate()

    def known_points(self, image: int) -> tuple[FloatArray, FloatArray]:
        """Return the triangulated points of an image's tracks, (M, 3), and its rays to them, (M, 3)."""
        observations = self._track_of_image[image]
        points = self.points_in_world[self.tracks.track_idx[observations]]
        known = np.isfinite(points[:, 0])
        return points[known], self.tracks.bearings[observations[known]]

    def attach_all(self, images: Iterable[int], *, after_each: Callable[[], None] = lambda: None) -> dict[int, str]:
        """Attach images, the one with most known points first; return the reasons for those that cannot be attached."""
        left = list(images)
        while left:
            known = self.known_counts()
            for image in sorted(left, key=lambda i: (-known[i], i)):
                if attachment := self.attach(image):
                    self.add(image, attachment.cam_from_world)
                    left.remove(image)
                    break
            else:
                break
            after_each()
        return {image: self.attach(image).reason for image in left}

    def known_counts(self) -> NDArray[np.intp]:
        """Return the number of triangulated points in the tracks of each image, (N,)."""
        known = np.isfinite(self.points_in_world[self.tracks.track_idx, 0])
        return np.bincount(self.tracks.image_idx[known], minlength=len(self.tracks.names))

    def attach(self, image: int) -> Attachment:
        """Estimate the pose of an image from its pairs with registered images, and decide whether it is reliable."""
        points, bearings = self.known_points(image)
        if len(points) < MIN_POINTS:
            return Attachment(Rigid3.identity(), 0, len(points), self._too_few(image, len(points)))
        guesses = [guess for partner in self._partners(image) if (guess := self._chained(image, partner))]
        if not guesses:
            return Attachment(
                Rigid3.identity(),
                0,
                len(points),
                "no pair with a registered image shares enough points with a third image to determine the distance",
            )
        pose = max(guesses, key=lambda g: int((resection_errors(g, points, bearings) < FIRST_GUESS_RAD).sum()))
        pose, support = refined_on_points(pose, points, bearings)
        enough = support >= points_needed(len(points))
        return Attachment(pose, support, len(points), "" if enough else why_few_seen(support, len(points)))

    def _partners(self, image: int) -> list[int]:
        """Return the registered partners of an image, sorted by number of verified matches."""
        return [partner for _, partner in self._pairs[image] if partner in self.cameras][:8]

    def _chained(self, image: int, partner: int) -> Rigid3 | None:
        """Return the pose from one partner: rotation and direction of the pair, and the length from known points.

        For a point at range d from the partner in the world and at range d' in units of the pair's translation, the
        length of the translation is d / d' (the paper's translation scale factor).
        """
        image_from_partner = relative_pose(self.edges, partner, image)
        seen, mine, theirs = np.intersect1d(
            self.tracks.track_idx[self._track_of_image[image]],
            self.tracks.track_idx[self._track_of_image[partner]],
            assume_unique=True,
            return_indices=True,
        )
        p = self.tracks.bearings[self._track_of_image[partner][theirs]]
        q = self.tracks.bearings[self._track_of_image[image][mine]]
        (unit_range, _), parallax = unit_ranges(image_from_partner, p, q)
        ratios = np.linalg.norm(self.points_in_world[seen] - self.cameras[partner].center, axis=1) / unit_range
        usable = np.isfinite(ratios)
        if usable.sum() < MIN_RATIOS:
            return None
        length = estimate_scale(
            ratios[usable], np.sin(parallax[usable]) ** 2, estimator=self.estimator, kappa=self.kappa
        )
        scaled = Rigid3(image_from_partner.rotation, length * image_from_partner.translation)
        return scaled @ self.cameras[partner]

    def _too_few(self, image: int, known: int) -> str:
        count, partner = max((-negative, partner) for negative, partner in self._pairs[image])
        return why_few_known(known, partner=self.tracks.names[partner], matches=count)

    def _arrays(self) -> tuple[FloatArray, FloatArray]:
        rotations = np.tile(np.eye(3), (len(self.tracks.names), 1, 1))
        centers = np.zeros((len(self.tracks.names), 3))
        for image, camera in self.cameras.items():
            rotations[image], centers[image] = camera.rotation, camera.center
        return rotations, centers
