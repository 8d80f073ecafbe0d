"""Check poses of any origin against the images, and correct cameras for which another pose explains more."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.adjustment.tracks import poses_with_points
from pano_mvs.algorithms.poses.frame.gauge import normalised_poses
from pano_mvs.algorithms.poses.placement.placed_model import NO_FEATURES, Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.belief.doubts import MISS_COST
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Picture
from pano_mvs.algorithms.poses.verification.correct_cameras import CameraChecks, correct_cameras
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import join_groups, split_groups


@checks_settings
def verify_poses(
    poses: Poses,
    load: Callable[[str], Picture],
    *,
    features: Mapping[str, Features] | None = None,
    two_views: Mapping[tuple[str, str], TwoView] | None = None,
    correct: Annotated[
        bool, Setting("move or remove cameras that the images contradict; false only reports them")
    ] = True,
    miss_cost: Annotated[
        float, Setting("cost of a wrong camera that is not doubted, relative to that of a right one that is", gt=0)
    ] = MISS_COST,
) -> Poses:
    """Check poses against the images: confirmed and expected shares, doubts, corrections.

    Every camera is swept with its neighbours at 256 columns. All measurements together give the probability that each
    camera is right (`docs/method.md`). Each doubtful camera is moved to the place with which all cameras are confirmed
    most. If it is doubtful still, it is reported, or left out if it is as surely wrong as others are right.

    Args:
        poses: of any origin. Cameras that are neither moved nor split off keep their poses exactly.
        load: returns the panorama and the mask of an image by its name.
        features: key points by image name; without them and `two_views` no camera is moved or left out.
        two_views: verified pairs.
        miss_cost: a camera is doubted if its probability to be right is below miss_cost / (1 + miss_cost), and left out
            if it is doubted and below 1 / (1 + miss_cost).

    Returns:
        The poses with `confirmed_shares`, `expected_shares`, `evidence`, `right_probabilities` and `doubts`. Points are
        triangulated again if a camera was moved or left out. A group that is split off has a world of its own, with the
        first camera as the frame and the first baseline as the unit.
    """
    if len(poses.names) < 2:
        return poses
    known = {**features, **{name: NO_FEATURES for name in poses.names if name not in features}} if features else {}
    usable = {pair: view for pair, view in (two_views or {}).items() if features and features.keys() >= {*pair}}
    capture = _Capture(load, known, usable, names=poses.names)
    return _verified(poses, capture, correct=correct, miss_cost=miss_cost)


class _Capture:
    """The images of a capture, their pairs, and small sweeps of them."""

    def __init__(
        self,
        load: Callable[[str], Picture],
        features: Mapping[str, Features],
        two_views: Mapping[tuple[str, str], TwoView],
        *,
        names: Sequence[str],
    ) -> None:
        self.features, self.two_views = features, two_views
        self.names = tuple(features) or tuple(names)
        self.position = {name: idx for idx, name in enumerate(self.names)}
        self.confirmation = Confirmation(lambda image: load(self.names[image]))

    @cached_property
    def pairs(self) -> Pairs:
        """All pairs."""
        return self.pairs_among(self.names)

    def pairs_among(self, names: Collection[str]) -> Pairs:
        """Return the pairs among some images."""
        inside = {pair: view for pair, view in self.two_views.items() if {*pair} <= {*names}}
        return pairs_of(self.features, inside) if self.features else Pairs.without(self.names)

    def model(self, group: Poses) -> PlacedModel:
        """Return the cameras of a group, with the pairs among its images, also those that its poses explain alone."""
        cameras = {self.position[name]: pose for name, pose in group.cameras.items()}
        model = PlacedModel(self.pairs_among(group.names)).with_cameras(cameras)
        model.verify_again()
        return model.with_cameras(cameras)


def _verified(poses: Poses, capture: _Capture, *, correct: bool, miss_cost: float) -> Poses:
    """Return poses whose groups are checked and corrected."""
    groups = []
    waiting = split_groups(poses)
    while waiting:
        group, split_off = _verified_group(waiting.pop(), capture, correct=correct, miss_cost=miss_cost)
        groups.append(group)
        waiting += split_off
    return join_groups(groups, order=poses.names, rejected=poses.rejected)


def _verified_group(poses: Poses, capture: _Capture, *, correct: bool, miss_cost: float) -> tuple[Poses, list[Poses]]:
    """Return poses of one group that are checked and corrected, and of groups that were split off, not checked yet."""
    model = capture.model(poses)
    pairs = model.pairs
    fixed = () if correct and pairs.compared else [*model.cameras]
    model, checks = correct_cameras(model, capture.confirmation, fixed=fixed, miss_cost=miss_cost)
    if checks.moved or checks.removed:
        moved = replace(poses_of(model), **poses.worlds[0]._asdict())
        poses = replace(moved, rejected={pairs.names[idx]: why for idx, why in checks.removed.items()})
    split_off = [normalised_poses(poses_of(part)) for part in checks.split_off]
    return with_camera_checks(poses, pairs, checks), split_off


def poses_of(model: PlacedModel) -> Poses:
    """Return the cameras of a model as poses of one group, with points."""
    tracks, members = model.tracks()
    poses = Poses.without_points(
        {model.pairs.names[image]: model.cameras[image] for image in members},
        frame="the first registered camera",
        scale="the first reference–neighbour baseline is 1",
        metric=False,
    )
    return poses_with_points(poses, tracks, max_error_deg=0.4, min_angle_deg=1.0)


def with_camera_checks(poses: Poses, pairs: Pairs, checks: CameraChecks) -> Poses:
    """Return poses of one group with the evidence for and against each camera."""
    position = {name: idx for idx, name in enumerate(pairs.names)}

    def of_each(values: Mapping[int, float]) -> np.ndarray:
        return np.array([values.get(position[name], np.nan) for name in poses.names], np.float64)

    return replace(
        poses,
        confirmed_shares=of_each({idx: own.share for idx, own in checks.of_images.items()}) if checks.asked else None,
        expected_shares=of_each({idx: own.expected for idx, own in checks.of_images.items()}) if checks.asked else None,
        evidence={
            pairs.names[idx]: {key: float(value) if np.isfinite(value) else None for key, value in row.items()}
            for idx, row in checks.evidence.items()
        },
        right_probabilities=of_each(checks.p_right),
        doubts={pairs.names[idx]: why for idx, why in sorted(checks.doubts.items())},
    )
