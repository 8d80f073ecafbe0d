"""A model that grows by one image at a time: its cameras, the chosen geometry of every pair, and known ranges."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, RobustLoss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.lengths import lengths_of, open_lengths, pairs_of_scales
from pano_mvs.algorithms.poses.adjustment.tracks import Tracks, Triangulated, build_tracks, triangulate_observations
from pano_mvs.algorithms.poses.placement.pair_evidence import (
    Geometry,
    PairEvidence,
    ScaleOf,
    estimate_scale,
    gather_pair_evidence,
    geometries_of,
    oriented,
)
from pano_mvs.algorithms.poses.placement.places import Placement, agreement, placements
from pano_mvs.algorithms.poses.placement.resection import MAX_ERROR_RAD, MIN_POINTS, points_seen, refined_on_points
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups, consistent_edges, views_by_position
from pano_mvs.algorithms.two_view.verification import verify_pose, weight_of_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle, ranges_from_bearings
from pano_mvs.scene import Features, TwoView

NO_FEATURES = Features(
    bearings=np.zeros((0, 3)),
    descriptors=np.zeros((0, 1), np.float32),
    sizes_rad=np.zeros(0, np.float32),
    scores=np.zeros(0, np.float32),
    colors_rgb=np.zeros((0, 3), np.uint8),
    metric="l2",
    size_hw=(1, 2),
)
"""Those of an image of which only the name is known."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a capture with all their geometries."""

    features: Mapping[str, Features]  # key points by image name, in the capture's order
    geometries: Mapping[Edge, tuple[Geometry, ...]]  # (i, j), i < j, to the geometries of the pair, the heaviest first
    scale_of: ScaleOf = estimate_scale  # estimates translation scale factors from the ratios of single features
    # (i, j), i < j, to the two-view geometry of each pair that a matcher has compared, with or without success; None:
    # all, without matches
    compared: Mapping[Edge, TwoView] | None = None
    names: tuple[str, ...] = field(init=False)
    bearings: tuple[FloatArray, ...] = field(init=False)
    partners: tuple[tuple[int, ...], ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.features))
        object.__setattr__(self, "bearings", tuple(found.bearings for found in self.features.values()))
        by_image: list[list[tuple[int, int]]] = [[] for _ in self.names]
        for (first, second), found in self.geometries.items():
            most = max(len(geometry.view) for geometry in found)
            by_image[first].append((-most, second))
            by_image[second].append((-most, first))
        object.__setattr__(self, "partners", tuple(tuple(idx for _, idx in sorted(pairs)) for pairs in by_image))

    @cached_property
    def learned_weights(self) -> dict[Edge, float]:
        """What the most probable geometry of each pair of learned matches weighs (`weight_of_pair`), if anything."""
        found = {}
        for edge, view in (self.compared or {}).items():
            one, other = (self.features[self.names[image]] for image in edge)
            geometry = view if view else next(iter(view.alternatives), None)
            if geometry is not None and view.geometry != "rotation" and one.learned and other.learned:
                weight = weight_of_pair(one, other, geometry, log10_false_alarms=view.log10_false_alarms)
                weight = max(weight, float(bool(view)))  # by walls, or links of a tour
                if weight:
                    found[edge] = weight
        return found

    def consistent(self) -> Pairs:
        """Return the pairs without those whose rotations contradict those of other pairs."""
        names = self.names
        views = {(names[a], names[b]): view for (a, b), view in (self.compared or {}).items()}
        kept = consistent_edges(names, views)
        return replace(self, geometries={edge: self.geometries[edge] for edge in kept})

    @staticmethod
    def without(names: Sequence[str]) -> Pairs:
        """Return pairs without key points and matches, for images of which only the names are known."""
        return Pairs(dict.fromkeys(names, NO_FEATURES), {})


def pairs_of(
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    scale_of: ScaleOf = estimate_scale,
    consistent: bool = True,
) -> Pairs:
    """Return the pairs of a capture, with all geometries.

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs.
        scale_of: estimates translation scale factors from the ratios of single features.
        consistent: whether to leave out pairs whose rotations contradict those of other pairs.
    """
    names = tuple(features)
    compared = views_by_position(names, two_views)
    edges = (
        consistent_edges(names, two_views) if consistent else {edge: view for edge, view in compared.items() if view}
    )
    geometries = {
        (a, b): geometries_of(view, features[names[a]].bearings, features[names[b]].bearings)
        for (a, b), view in edges.items()
    }
    return Pairs(features, geometries, scale_of, compared)


@dataclass(eq=False)
class PlacedModel:
    """Registered cameras; the world frame is that of the first camera that was added."""

    pairs: Pairs  # all pairs of the capture
    cameras: dict[int, Rigid3] = field(default_factory=dict)  # image position to cam_from_world
    # pair of registered images to the rank of the geometry that agrees with their cameras. Pairs without such a
    # geometry are left out.
    chosen: dict[Edge, int] = field(default_factory=dict)
    # image position to the ranges (N,) of its key points that images confirm, NaN where unknown; for placing cameras
    confirmed_ranges: dict[int, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._ranges = [np.full(len(rays), np.nan) for rays in self.pairs.bearings]
        self._parallax = [np.zeros(len(rays)) for rays in self.pairs.bearings]

    def copy(self) -> PlacedModel:
        """Return a model that can be changed independently."""
        model = PlacedModel(self.pairs, dict(self.cameras), dict(self.chosen))
        model._ranges = [ranges.copy() for ranges in self._ranges]
        model._parallax = [parallax.copy() for parallax in self._parallax]
        return model

    def known_ranges(self, image: int) -> FloatArray:
        """Return the ranges of all key points of an image, (N,), NaN where unknown; not a copy."""
        return self._ranges[image]

    def evidence(self, image: int, partners: Sequence[int] | None = None) -> PairEvidence:
        """Return the evidence of the pairs of an image with all, or with the given, registered images for its pose."""
        if partners is None:
            partners = [idx for idx in self.pairs.partners[image] if idx in self.cameras][:16]
        return gather_pair_evidence(
            image,
            partners,
            geometries=self.pairs.geometries,
            cameras=self.cameras,
            ranges={partner: self._ranges_to_place(partner) for partner in partners},
            scale_of=self.pairs.scale_of,
        )

    def _ranges_to_place(self, image: int) -> FloatArray:
        """Return the ranges of all key points of an image, those of triangulated points first."""
        own = self._ranges[image]
        return np.where(np.isfinite(own), own, self.confirmed_ranges[image]) if image in self.confirmed_ranges else own

    def place(self, image: int, *, most: int = 6) -> tuple[PairEvidence, list[Placement]]:
        """Return the evidence of the pairs of an image for its pose, and the poses on which they agree, best first."""
        evidence = self.evidence(image)
        return evidence, placements(evidence, most=most)

    def add(self, image: int, cam_from_world: Rigid3) -> None:
        """Register an image, choose the geometries of its pairs that agree, and update ranges from them."""
        self.cameras[image] = cam_from_world
        for edge in [edge for edge in self.chosen if image in edge]:
            del self.chosen[edge]
        for edge, rank in self._agreeing(image).items():
            self.chosen[edge] = rank
            self._learn_ranges(edge)

    def _agreeing(self, image: int) -> dict[Edge, int]:
        """Return the pairs of a registered image, each with the rank of its heaviest geometry that agrees."""
        evidence, pose = self.evidence(image), self.cameras[image]
        agrees = agreement(evidence, pose.rotation[None], pose.center[None])[0]
        return {_edge(image, partner): rank for partner, rank in explained_partners(evidence, agrees).items()}

    def agrees_with(self, edge: Edge, view: TwoView) -> bool:
        """Return whether a geometry of a pair of registered images has their rotation and direction."""
        relative = self.cameras[edge[1]] @ self.cameras[edge[0]].inverse()
        turned = geodesic_angle(view.rotation, relative.rotation)
        return bool(
            turned < float(np.deg2rad(3.0))
            and angle_between(view.direction, relative.translation) < float(np.deg2rad(10.0))
        )

    def is_same_arrangement(self, other: PlacedModel) -> bool:
        """Return whether another model of the same pairs has the same images, and they are arranged alike."""
        return self.cameras.keys() == other.cameras.keys() and all(
            other.agrees_with(edge, self.pairs.geometries[edge][rank].view) for edge, rank in self.chosen.items()
        )

    def with_cameras(self, cameras: Mapping[int, Rigid3]) -> PlacedModel:
        """Return a model of the same pairs with other cameras, whose geometries and ranges depend on these alone."""
        model = PlacedModel(self.pairs, dict(cameras))
        model.choose_again()
        model.learn_ranges()
        model.choose_again()
        return model

    def groups_held_by(self, images: Collection[int]) -> list[list[int]]:
        """Return the groups of images that only pairs with some images connect to the larger part of their group."""
        left = [edge for edge in self.chosen if not {*edge} & {*images}]
        parts = [{*part} - {*images} for part in connected_groups(left, len(self.pairs.names))]
        held = []
        for group in connected_groups(self.chosen, len(self.pairs.names)):
            if {*group} & {*images}:
                held += [sorted(part) for part in parts if part and part <= {*group}][1:]
        return held

    def seed(self, edge: Edge, rank: int) -> None:
        """Start with a pair of images, in the frame of the first image, one unit of length apart."""
        view = self.pairs.geometries[edge][rank].view
        self.cameras = {edge[0]: Rigid3.identity(), edge[1]: Rigid3(view.rotation, view.direction)}
        self.chosen = {edge: rank}
        self._learn_ranges(edge)

    def known_points(self, image: int, explained: Mapping[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return known points that an image matches, (M, 3), and its rays to them, (M, 3).

        Args:
            image: the image.
            explained: registered partners, each with the rank of the geometry whose matches are used.
        """
        points, rays = [np.zeros((0, 3))], [np.zeros((0, 3))]
        seen = np.zeros(len(self.pairs.bearings[image]), np.bool_)
        for partner, rank in explained.items():
            view = self.pairs.geometries[_edge(image, partner)][rank].view
            _, matches = oriented(view, partner, image)
            ranges = self._ranges_to_place(partner)[matches[:, 0]]
            fresh = np.isfinite(ranges) & ~seen[matches[:, 1]]
            theirs, mine = matches[fresh, 0], matches[fresh, 1]
            seen[mine] = True
            camera = self.cameras[partner]
            points.append(ranges[fresh, None] * self.pairs.bearings[partner][theirs] @ camera.rotation + camera.center)
            rays.append(self.pairs.bearings[image][mine])
        return np.concatenate(points), np.concatenate(rays)

    def polished(self, image: int, evidence: PairEvidence, placement: Placement) -> tuple[Rigid3, int, int]:
        """Return the pose refined on known points, how many of them it sees where it should, and how many it matches.

        A placement that matches too few known points is returned as it is.
        """
        points, rays = self.known_points(image, explained_partners(evidence, placement.explained))
        pose = placement.cam_from_world
        if len(points) < MIN_POINTS:
            return pose, 0, len(points)
        return *refined_on_points(pose, points, rays), len(points)

    def polished_near_pairs(self, image: int, evidence: PairEvidence, placement: Placement) -> tuple[Rigid3, int, int]:
        """Return what `polished` does, or the placement as it is if no geometry that suggests it agrees any more.

        Known points that move it so far are false, or the place is; it is then judged by what it sees unrefined. Where
        images confirm the refined pose, `polished` is enough: the direction to a camera nearby is not well known.
        """
        pose, support, known = self.polished(image, evidence, placement)
        if (agreement(evidence, pose.rotation[None], pose.center[None])[0] & placement.explained).any():
            return pose, support, known
        points, rays = self.known_points(image, explained_partners(evidence, placement.explained))
        return placement.cam_from_world, points_seen(placement.cam_from_world, points, rays), known

    def adjust(self, *, cameras: bool = True) -> None:
        """Refine all cameras except the first together with the points, and compute all ranges again.

        Args:
            cameras: False keeps the cameras fixed and only triangulates.
        """
        tracks, members = self.tracks()
        found = self._triangulated(tracks, members)
        if cameras:
            bundle = Bundle(
                rotations=np.array([self.cameras[image].rotation for image in members]),
                centers=np.array([self.cameras[image].center for image in members]),
                points=found.points_in_world[found.valid],
                point_idx=(np.cumsum(found.valid) - 1)[tracks.track_idx[found.used]].astype(np.int32),
                image_idx=tracks.image_idx[found.used],
                bearings=tracks.bearings[found.used],
            )
            loss, scales = RobustLoss("cauchy", MAX_ERROR_RAD / 4), pairs_of_scales(bundle)
            # Otherwise, a room that one pair joins with the rest moves along the direction of the pair.
            lengths = open_lengths(bundle, scales, lengths_of(scales, bundle.centers), scale_rad=loss.scale_rad)
            bundle = adjust_bundle(
                replace(bundle, lengths=lengths),
                loss,
                max_iterations=20,
                tolerance=1e-3,  # the finished model is refined anyway
                fixed_camera=members.index(next(iter(self.cameras))),
            )
            for image, rotation, center in zip(members, bundle.rotations, bundle.centers, strict=True):
                self.cameras[image] = Rigid3.from_center(rotation, center)
            found = self._triangulated(tracks, members)
        points = found.points_in_world[tracks.track_idx]
        known = np.isfinite(points[:, 0])
        centers = np.array([self.cameras[image].center for image in members])
        distances = np.linalg.norm(points - centers[tracks.image_idx], axis=1)
        for idx, image in enumerate(members):
            mine = known & (tracks.image_idx == idx)
            self._ranges[image][:], self._parallax[image][:] = np.nan, 0
            self._ranges[image][tracks.keypoint_idx[mine]] = distances[mine]
            self._parallax[image][tracks.keypoint_idx[mine]] = np.pi

    def _triangulated(self, tracks: Tracks, members: Sequence[int]) -> Triangulated:
        """Return the points of tracks among registered images."""
        rotations = np.array([self.cameras[image].rotation for image in members])[tracks.image_idx]
        return triangulate_observations(
            np.array([self.cameras[image].center for image in members])[tracks.image_idx],
            np.einsum("nji,nj->ni", rotations, tracks.bearings),
            tracks.track_idx,
            count=tracks.count,
            max_error_rad=MAX_ERROR_RAD,
            min_angle_rad=float(np.deg2rad(1.0)),
        )

    def tracks(self) -> tuple[Tracks, list[int]]:
        """Return the tracks that the chosen geometries form among registered images, and the position of each image."""
        members = sorted(self.cameras)
        names = self.pairs.names
        return build_tracks(
            {names[image]: self.pairs.features[names[image]] for image in members}, self.views()
        ), members

    def views(self) -> dict[tuple[str, str], TwoView]:
        """Return the chosen geometries by image names."""
        names = self.pairs.names
        return {
            (names[a], names[b]): self.pairs.geometries[a, b][rank].view for (a, b), rank in sorted(self.chosen.items())
        }

    def choose_again(self) -> None:
        """Choose the geometry of every pair of registered images again, by the current cameras."""
        self.chosen = {}
        for image in sorted(self.cameras):
            for edge, rank in self._agreeing(image).items():
                self.chosen.setdefault(edge, rank)

    def verify_again(self) -> None:
        """Verify pairs of registered images that no geometry explains again, by the relative poses of their cameras.

        Given the pose, fewer matches are more than chance than in a search for it (see `verify_pose`).
        """
        self.choose_again()
        found = dict(self.pairs.geometries)
        for edge, view in (self.pairs.compared or {}).items():
            if edge in self.chosen or not self.cameras.keys() >= {*edge} or not len(view.all_matches_idx):
                continue
            first, second = (self.pairs.features[self.pairs.names[image]] for image in edge)
            pose = self.cameras[edge[1]] @ self.cameras[edge[0]].inverse()
            again = verify_pose(first, second, view.all_matches_idx, pose=pose, rng=np.random.default_rng(0))
            if again:
                found[edge] = (*found.get(edge, ()), *geometries_of(again, first.bearings, second.bearings))
        self.pairs = replace(self.pairs, geometries=found)
        self.choose_again()

    def learn_ranges(self) -> None:
        """Compute the ranges of all matches of the chosen geometries again."""
        for ranges, parallax in zip(self._ranges, self._parallax, strict=True):
            ranges[:], parallax[:] = np.nan, 0
        for edge in sorted(self.chosen):
            self._learn_ranges(edge)

    def _learn_ranges(self, edge: Edge) -> None:
        """Use the ranges of a pair's matches where their parallax is larger than that of the known ranges."""
        first, second = edge
        view = self.pairs.geometries[edge][self.chosen[edge]].view
        relative = self.cameras[second] @ self.cameras[first].inverse()
        mine, theirs = view.matches_idx[:, 0], view.matches_idx[:, 1]
        p, q = self.pairs.bearings[first][mine], self.pairs.bearings[second][theirs]
        ranges = ranges_from_bearings(p, q, relative)
        parallax = angle_between(p @ relative.rotation.T, q)
        with np.errstate(invalid="ignore"):
            usable = (ranges[0] > 0) & (ranges[1] > 0) & (parallax > float(np.deg2rad(1.5)))
        usable &= view.residuals_rad < MAX_ERROR_RAD
        for image, keypoints, found in ((first, mine, ranges[0]), (second, theirs, ranges[1])):
            better = usable & (parallax > self._parallax[image][keypoints])
            self._ranges[image][keypoints[better]] = found[better]
            self._parallax[image][keypoints[better]] = parallax[better]


def explained_partners(evidence: PairEvidence, explained: NDArray[np.bool_]) -> dict[int, int]:
    """Return the partners with a geometry that agrees, each with the rank of its heaviest such geometry."""
    found: dict[int, int] = {}
    for idx in np.flatnonzero(explained):
        found.setdefault(int(evidence.partner[idx]), int(evidence.rank[idx]))
    return found


def _edge(a: int, b: int) -> Edge:
    return min(a, b), max(a, b)
