"""The evidence for and against each camera of a model: one row of measurements per camera, NaN where one is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.pair_evidence import Geometry
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups
from pano_mvs.algorithms.poses.verification.camera_checks import BlockMove, block_moves
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.algorithms.poses.verification.joints import Joint, measured_joints
from pano_mvs.algorithms.poses.verification.verify_poses import VerifiedGroup
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features

FloatArray = NDArray[np.float64]
Row = dict[str, float]

_COPY = 0.01  # cameras nearer than this share of the usual distance are at the same place


def camera_evidence(group: VerifiedGroup) -> dict[str, Row]:
    """Return the evidence for each camera of a group, measured after all choices were made.

    Returns:
        Image name to the name and value of each measurement; NaN if it could not be made.
    """
    model, checks, confirmation = group.model, group.checks, group.confirmation
    joints, moves = list(measured_joints(model, confirmation)), block_moves(model, confirmation)
    images = sorted(model.cameras)
    rows: dict[int, Row] = {image: {} for image in images}
    spacing = _nearest_distances(model.cameras)
    usual = float(np.median(list(spacing.values())))
    copies = {image for image in images if spacing[image] < _COPY * usual}
    shares = [share for share in checks.shares.values() if np.isfinite(share)]
    shared = {
        "images": float(len(images) - len(copies) // 2),
        "explained_in_all": model.explained_share() if model.pairs.geometries else np.nan,
        "confirmed_in_all": float(np.median(shares)) if shares else np.nan,
    }
    bridges = _bridges(model)
    heights = _heights(model.cameras, usual)
    triangles = _triangles(model)
    seen, residuals = _points(model)
    for image in images:
        share, expected = checks.shares.get(image, np.nan), checks.expected.get(image, np.nan)
        rows[image] = {
            **shared,
            "share": share,
            "expected": expected,
            "ratio": share / expected if expected > 0 else np.nan,
            **_of_pairs(model, image),
            **_rival(model, image, confirmation),
            **triangles[image],
            "points": seen.get(image, 0.0),
            "residual_deg": residuals.get(image, np.nan),
            "bridge_matches": bridges.get(image, np.nan),
            "height": heights.get(image, np.nan),
            "spacing": spacing[image] / usual if usual > 0 else np.nan,
            "copy": float(image in copies),
            **_alias(model, moves, image),
            **_weakest_joint(model, joints, image),
        }
    return {model.pairs.names[image]: row for image, row in rows.items()}


def _nearest_distances(cameras: Mapping[int, Rigid3]) -> dict[int, float]:
    images = sorted(cameras)
    centers = np.array([cameras[image].center for image in images])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return dict(zip(images, apart.min(axis=1).tolist(), strict=True))


def _chosen(model: PlacedModel, image: int) -> list[tuple[Edge, Geometry]]:
    """Return the geometries that agree with a camera, the one with most matches first."""
    found = [(edge, model.pairs.geometries[edge][rank]) for edge, rank in model.chosen.items() if image in edge]
    return sorted(found, key=lambda item: (-len(item[1].view), item[0]))


def _of_pairs(model: PlacedModel, image: int) -> Row:
    """Return how well the pairs of a camera agree with it, and how sure they are of themselves."""
    found = _chosen(model, image)
    partners = [idx for idx in model.pairs.partners[image] if idx in model.cameras] if model.pairs.partners else []
    alarms = sorted((-one.view.log10_false_alarms for _, one in found), reverse=True)
    matches = [float(len(one.view)) for _, one in found]
    rivals, rival_matches = [], []
    learned = total = 0
    for edge, one in found:
        others = [other for other in model.pairs.geometries[edge] if other is not one]
        rivals.append(max((other.weight for other in others), default=0.0) / max(one.weight, 1e-9))
        rival_matches.append(max((len(other.view) for other in others), default=0) / max(len(one.view), 1))
        own = np.array([_own_keypoints(model.pairs.features[model.pairs.names[idx]]) for idx in edge])
        learned += int((one.view.matches_idx >= own).any(axis=1).sum())
        total += len(one.view)
    evidence = model.evidence(image, [edge[0] if edge[1] == image else edge[1] for edge, _ in found])
    actual = np.linalg.norm(model.cameras[image].center - evidence.origins, axis=1)
    agreeing = np.array(
        [
            model.chosen.get((min(image, int(p)), max(image, int(p)))) == r
            for p, r in zip(evidence.partner, evidence.rank, strict=True)
        ],
        np.bool_,
    )
    known = agreeing & np.isfinite(evidence.lengths) & (actual > 0)
    spread = np.abs(np.log(evidence.lengths[known] / actual[known]))
    nothing = not found
    return {
        "partners": float(len(partners)),
        "agreeing": float(len(found)),
        "explained": model.explained_share_of(image) if partners else np.nan,
        "alarms_best": alarms[0] if alarms else 0.0,
        "alarms_second": alarms[1] if len(alarms) > 1 else 0.0,
        "matches_best": matches[0] if matches else np.nan,
        "matches_second": matches[1] if len(matches) > 1 else np.nan,
        "matches": float(sum(matches)),
        "rival_of_best": rivals[0] if rivals else np.nan,
        "rival_weight": float(np.average(rivals, weights=matches)) if rivals and sum(matches) else np.nan,
        "rival_matches": float(np.average(rival_matches, weights=matches)) if rivals and sum(matches) else np.nan,
        "rivalled": float(np.mean(np.array(rivals) > 0.4)) if rivals else np.nan,
        "learned_share": learned / total if total else np.nan,
        "parallax_deg": max((one.parallax_deg for _, one in found), default=0.0),
        "direction_std_deg": np.nan if nothing else min(one.direction_std_deg for _, one in found),
        "known_lengths": float(known.sum()),
        "scale_spread": float(np.median(spread)) if len(spread) else np.nan,
        "scale_worst": float(spread.max()) if len(spread) else np.nan,
    }


def _own_keypoints(features: Features) -> int:
    return len(features) - features.learned


def _rival(model: PlacedModel, image: int, confirmation: Confirmation) -> Row:
    """Return how another place that the pairs of a camera suggest compares, by weight and by what images confirm."""
    _, places = model.place(image) if len(model.cameras) > 2 and model.pairs.partners else (None, [])
    here = model.cameras[image]
    own = sum(model.pairs.geometries[edge][rank].weight for edge, rank in model.chosen.items() if image in edge)
    distances = [
        float(np.linalg.norm(pose.center - here.center)) for idx, pose in model.cameras.items() if idx != image
    ]
    near = 0.1 * min(distances)
    elsewhere = [
        place
        for place in places
        if float(np.linalg.norm(place.cam_from_world.center - here.center)) > near
        or float(np.linalg.norm(place.cam_from_world.rotation - here.rotation)) > 0.1
    ]
    if not elsewhere or own <= 0:
        return {"place_rival": 0.0 if places else np.nan, "place_gain": np.nan, "place_moved": np.nan}
    rival = elsewhere[0]
    score = rival.score / own
    gain = np.nan
    if score > 0.3:
        before = confirmation.share(image, here, model.cameras)
        after = confirmation.share(image, rival.cam_from_world, model.cameras)
        gain = float((after + 0.01) / (before + 0.01))
    moved = float(np.linalg.norm(rival.cam_from_world.center - here.center)) / float(np.median(distances))
    return {"place_rival": score, "place_gain": gain, "place_moved": moved}


def _triangles(model: PlacedModel) -> dict[int, Row]:
    """Return how many triangles of compared pairs agree in all sides, and the share of the others."""
    closed = dict.fromkeys(model.cameras, 0)
    broken = dict.fromkeys(model.cameras, 0)
    edges = {edge for edge in model.pairs.geometries if model.cameras.keys() >= {*edge}}
    after: dict[int, set[int]] = {}
    for first, second in edges:
        after.setdefault(first, set()).add(second)
    for i, j in edges:
        for k in after[i] & after.get(j, set()):
            agree = all(edge in model.chosen for edge in ((i, j), (j, k), (i, k)))
            for image in (i, j, k):
                if agree:
                    closed[image] += 1
                else:
                    broken[image] += 1
    return {
        image: {"triangles": float(closed[image]), "broken": broken[image] / max(1, closed[image] + broken[image])}
        for image in model.cameras
    }


def _points(model: PlacedModel) -> tuple[dict[int, float], dict[int, float]]:
    """Return the number of points that each camera and two others see, and the median angle by which it misses them."""
    if not model.chosen:
        return {}, {}
    tracks, members = model.tracks()
    seen: dict[int, float] = {}
    residuals: dict[int, float] = {}
    if not len(tracks.track_idx):
        return seen, residuals
    length = np.bincount(tracks.track_idx, minlength=tracks.count)
    long = length[tracks.track_idx] >= 3
    poses = [model.cameras[image] for image in members]
    centers = np.array([pose.center for pose in poses])
    rotations = np.array([pose.rotation for pose in poses])
    rays = np.einsum("nji,nj->ni", rotations[tracks.image_idx], tracks.bearings)
    # Mid-points of the rays of each track: least squares of the distances to its rays.
    projector = np.eye(3) - rays[:, :, None] * rays[:, None]
    matrix = np.zeros((tracks.count, 3, 3))
    vector = np.zeros((tracks.count, 3))
    np.add.at(matrix, tracks.track_idx, projector)
    np.add.at(vector, tracks.track_idx, np.einsum("nij,nj->ni", projector, centers[tracks.image_idx]))
    points = np.linalg.solve(matrix + 1e-9 * np.eye(3), vector[..., None])[..., 0]
    towards = points[tracks.track_idx] - centers[tracks.image_idx]
    sine = np.linalg.norm(np.cross(towards, rays), axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    ahead = np.einsum("ni,ni->n", towards, rays) > 0
    angle = np.where(ahead, np.rad2deg(np.arcsin(np.minimum(sine, 1.0))), 180.0)
    for number, image in enumerate(members):
        mine = long & (tracks.image_idx == number)
        good = mine & (angle < 0.5)
        seen[image] = float(good.sum())
        if mine.any():
            residuals[image] = float(np.median(angle[mine]))
    return seen, residuals


def _bridges(model: PlacedModel) -> dict[int, float]:
    """Return the matches of the weakest pair that alone joins a camera to the largest part, if there is one."""
    images = sorted(model.cameras)
    number = {image: idx for idx, image in enumerate(images)}
    edges = sorted(model.chosen)
    weakest: dict[int, float] = {}
    for edge in edges:
        left = [(number[a], number[b]) for a, b in edges if (a, b) != edge]
        groups = connected_groups(left, len(images))
        together = next(group for group in groups if number[edge[0]] in group)
        if number[edge[1]] in together:
            continue
        sides = [group for group in groups if number[edge[0]] in group or number[edge[1]] in group]
        matches = float(len(model.pairs.geometries[edge][model.chosen[edge]].view))
        for side in sides:
            if len(side) == min(map(len, sides)):
                for idx in side:
                    weakest[images[idx]] = min(matches, weakest.get(images[idx], np.inf))
    return weakest


def _heights(cameras: Mapping[int, Rigid3], usual: float) -> dict[int, float]:
    """Return how far each camera is from the plane of the others, in usual distances, if there are five or more."""
    images = sorted(cameras)
    if len(images) < 5 or usual <= 0:
        return {}
    centers = np.array([cameras[image].center for image in images])
    found = {}
    for idx, image in enumerate(images):
        others = np.delete(centers, idx, axis=0)
        middle = np.median(others, axis=0)
        normal = np.linalg.svd(others - middle)[2][2]
        spread = float(np.median(np.abs((others - middle) @ normal)))
        found[image] = max(0.0, abs(float((centers[idx] - middle) @ normal)) - 2 * spread) / usual
    return found


def _alias(model: PlacedModel, moves: Sequence[BlockMove], image: int) -> Row:
    """Return the gain of moving a block by a motion that several pairs suggest, with the camera on its smaller side."""
    found = {"alias_gain": np.nan, "alias_pairs": 0.0, "alias_gain_elsewhere": np.nan}
    for gain, alias, labels in moves:
        found["alias_pairs"] = max(found["alias_pairs"], len(alias.signed_weights) / max(1, len(model.chosen)))
        same = sum(label == labels[image] for label in labels.values())
        key = "alias_gain" if 2 * same <= len(labels) else "alias_gain_elsewhere"
        found[key] = float(np.fmax(found[key], gain))
    return found


def _weakest_joint(model: PlacedModel, joints: Sequence[Joint], image: int) -> Row:
    """Return the evidence of the weakest joint on the best path from the camera's part to the largest part."""
    found = _path_to_largest(model, joints, image)
    if found is None:
        return dict.fromkeys(
            ("joint_matches", "joint_agreeing_sr", "joint_contradicting", "joint_density", "joint_rivals"), np.nan
        )
    seen = found.evidence.agreeing_sr + found.evidence.contradicting_sr if found.evidence else 0.0
    return {
        "joint_matches": float(found.matches),
        "joint_agreeing_sr": found.evidence.agreeing_sr if found.evidence else np.nan,
        "joint_contradicting": found.evidence.contradicting_sr / seen if found.evidence and seen > 0 else np.nan,
        "joint_density": found.evidence.density if found.evidence else np.nan,
        "joint_rivals": found.rivals,
    }


def _path_to_largest(model: PlacedModel, joints: Sequence[Joint], image: int) -> Joint | None:
    """Return the weakest joint, by matches, of the path whose weakest joint is strongest; None in the largest part."""
    parts = {tuple(part) for joint in joints for part in (joint.first, joint.second)}
    if not parts:
        return None
    largest = max(parts, key=lambda part: (len(part), [-idx for idx in part]))
    own = next((part for part in parts if image in part), None)
    if own is None or own == largest:
        return None
    reached: dict[tuple[int, ...], Joint | None] = {largest: None}
    while own not in reached:
        around = [
            (joint, there)
            for joint in joints
            for here, there in (
                (tuple(joint.first), tuple(joint.second)),
                (tuple(joint.second), tuple(joint.first)),
            )
            if here in reached and there not in reached
        ]
        if not around:
            return Joint(list(largest), list(own), None, 0, np.nan)
        joint, there = max(around, key=lambda item: (item[0].matches, item[1]))
        before = reached[tuple(joint.first) if tuple(joint.second) == there else tuple(joint.second)]
        reached[there] = joint if before is None or joint.matches <= before.matches else before
    return reached[own]
