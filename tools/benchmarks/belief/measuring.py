"""Solve one generated capture, and measure the evidence for each camera and whether it is right."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.learned.aliked import extract_aliked, joined
from pano_mvs.algorithms.learned.lightglue import match_learned
from pano_mvs.algorithms.learned.similar_pairs import learned_pairs
from pano_mvs.algorithms.learned.weak_images import weak_images
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import split_groups
from tools.benchmarks.belief.families import LARGE, LEARNED, Capture
from tools.benchmarks.poses.placements import judge_placements

Views = dict[tuple[str, str], TwoView]
VARIANTS = ("asked", "displaced", "pairs_alone", "halved", "thinned")
"""Poses were solved with the images, given with one camera in a wrong place, or solved by the pairs alone or without
every second or third image."""
_LEFT_OUT = {"halved": 2, "thinned": 3}
_LEARNED_KEYPOINTS, _LEARNED_VIEWS = 3000, 4


@dataclass(frozen=True)
class Measured:
    """One placed camera of a capture.

    Attributes:
        family: of the capture.
        seed: of the capture.
        variant: one of `VARIANTS`.
        note: what was drawn.
        learned: whether the capture has learned matches.
        name: of the image.
        group: number of its group; cameras of other groups have frames of their own.
        right: whether its pose is right.
        rotation_deg: its error.
        center_share: its error as a share of the extent of the capture.
        doubted: whether `verify_poses` doubts it.
        evidence: its measurements, None where one is missing.
    """

    family: str
    seed: int
    variant: str
    note: str
    learned: bool
    name: str
    group: int
    right: bool
    rotation_deg: float
    center_share: float
    doubted: bool
    evidence: dict[str, float | None]


def measure(capture: Capture) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Return the placed cameras of a capture in each variant as JSON objects, and the CPU-seconds of each step."""
    start = time.process_time()
    learned, large = capture.family.endswith(LEARNED), capture.family.endswith((LARGE, LEARNED))
    features, views = matched(capture, learned=learned)
    spent = {"matches": time.process_time() - start}

    def load(name: str) -> Picture:
        return capture.pictures[name], np.ones(capture.pictures[name].shape[:2], np.bool_)

    rng = np.random.default_rng([capture.seed, 7])
    number = capture.seed % 4
    # Half of the captures are solved as users do, half without asking the images, which leaves more cameras wrong. Half
    # of either are also given with a camera in a wrong place, because few cameras are wrong otherwise. Pictures and
    # matches of large captures cost much, so all of these are also solved with half of their images, and those with
    # learned matches, which cost most, in all ways.
    variants: tuple[str, ...] = ("pairs_alone" if number in (1, 2) else "asked",)
    variants += ("displaced", "halved") if large else ("displaced",) if number >= 2 else ()
    variants = VARIANTS if learned else variants
    groups: list[list[dict[str, Any]]] = []
    solved: Poses | None = None
    for variant in variants:
        start = time.process_time()
        if variant != "displaced" or solved is None:
            asks = load if variant != "pairs_alone" else None
            period = _LEFT_OUT.get(variant, len(features) + 1)
            kept = {name for position, name in enumerate(features, 1) if position % period}
            solved = solve_scaled_translation(
                {name: own for name, own in features.items() if name in kept},
                {pair: view for pair, view in views.items() if {*pair} <= kept},
                load=asks,
                rng=np.random.default_rng(1),
            )
        poses = _displaced(solved, rng) if variant == "displaced" else solved
        given = variant == "displaced"
        verified = verify_poses(poses, load, features=features, two_views=views, correct=not given)
        for group_number, found in enumerate(split_groups(verified)):
            if len(found.names) > 1:
                rows = rows_of(capture, variant, found, group=group_number, learned=learned)
                if not any(_is_same(rows, known) for known in groups):
                    groups.append(rows)
        spent[variant] = time.process_time() - start
    return [row for rows in groups for row in rows], spent


def _is_same(rows: Sequence[Mapping[str, Any]], known: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a group has the cameras of one that was measured in another way, and the same evidence."""
    if [row["name"] for row in rows] != [row["name"] for row in known]:
        return False
    values, others = (np.array([list(row["evidence"].values()) for row in each], np.float64) for each in (rows, known))
    return np.allclose(values, others, rtol=0.01, atol=1e-3, equal_nan=True)


def matched(capture: Capture, *, learned: bool) -> tuple[dict[str, Features], Views]:
    """Return key points and verified matches of all pairs, as presets find them; learned ones where SIFT is weak."""
    rng = np.random.default_rng(1)
    whole = {name: np.ones(image.shape[:2], np.bool_) for name, image in capture.pictures.items()}
    features = {name: extract_sift(image, whole[name]) for name, image in capture.pictures.items()}

    def verified(pair: tuple[str, str], *more: NDArray[np.int32]) -> TwoView:
        first, second = (features[name] for name in pair)
        found = match_features(first.without_learned(), second.without_learned())
        return verify_pair(first, second, np.concatenate([found, *more]), rng=rng)

    views = {pair: verified(pair) for pair in combinations(features, 2)}
    if not learned:
        return features, views
    poses = solve_scaled_translation(
        features, views, load=lambda name: (capture.pictures[name], whole[name]), rng=np.random.default_rng(1)
    )
    weak = weak_images(features, views, poses)
    for name in (*weak.weak, *weak.similar):
        points = extract_aliked(
            capture.pictures[name], whole[name], ups=[np.array([0.0, -1.0, 0.0])], max_keypoints=_LEARNED_KEYPOINTS
        )
        features[name] = joined(features[name], points)
    for pair in learned_pairs(features).pairs:
        view = verified(pair, match_learned(features[pair[0]], features[pair[1]], max_views=_LEARNED_VIEWS))
        if view or not views[pair]:
            views[pair] = view
    return features, views


def _displaced(poses: Poses, rng: np.random.Generator) -> Poses:
    """Return poses of which one camera was moved by up to two usual distances, or turned."""
    poses = split_groups(poses)[0]
    if len(poses.names) < 3:
        return poses
    image = int(rng.integers(len(poses.names)))
    centers = poses.centers
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.diag(np.full(len(centers), np.inf))
    away = rng.normal(size=3) * (1, 0.1, 1)
    pose = poses.cam_from_world(image)
    step = float(rng.uniform(0.1, 2.0)) * float(np.median(apart.min(axis=1))) * away / np.linalg.norm(away)
    turn = (
        rotation_from_rotvec((0.0, float(rng.choice([0.0, np.pi / 2, np.pi])), 0.0))
        if rng.random() < 0.3
        else np.eye(3)
    )
    moved = Rigid3.from_center(turn @ pose.rotation, pose.center + step)
    cameras = {name: moved if idx == image else poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    return Poses.without_points(cameras, frame=poses.frame, scale=poses.scale, metric=False)


def rows_of(
    capture: Capture,
    variant: str,
    found: Poses,
    *,
    group: int,
    learned: bool,
    limits: tuple[float, float] = (1.0, 0.02),
) -> list[dict[str, Any]]:
    """Return the cameras of a group (`Measured`) as JSON objects.

    Args:
        capture: with the truth.
        variant: how the group was solved.
        found: the poses of the group, with the evidence for each.
        group: its number.
        learned: whether the capture has learned matches.
        limits: errors up to which a camera is right, in degrees and as a share of the extent.
    """
    placed = judge_placements(found, capture.truth, rotation_limit_deg=limits[0], center_limit=limits[1])
    return [
        asdict(
            Measured(
                capture.family,
                capture.seed,
                variant,
                capture.note,
                learned,
                name,
                group,
                bool(placed.right[idx]),
                float(placed.rotation_deg[idx]),
                float(placed.center_shares[idx]),
                bool(placed.doubted[idx]),
                found.evidence[name],
            )
        )
        for idx, name in enumerate(placed.names)
    ]
