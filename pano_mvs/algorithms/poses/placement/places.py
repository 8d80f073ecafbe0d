"""Candidate poses of an image on which its pairs agree, best first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.pair_evidence import AGREEING, PairEvidence, best_by_partner
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, nearest_rotation


@dataclass(frozen=True, eq=False)
class Placement:
    """A pose on which some of an image's pairs agree."""

    cam_from_world: Rigid3  # the pose
    explained: NDArray[np.bool_]  # (W,) bool, the geometries that agree
    score: float  # sum over the partners of the weight of their heaviest geometry that agrees


def placements(evidence: PairEvidence, *, most: int = 6) -> list[Placement]:
    """Return the distinct poses that the geometries suggest, best score first.

    Each geometry with a known length suggests a pose, and so do two intersecting rays. Each candidate is scored by all
    geometries, counting at most one per partner: a geometry agrees with a pose that has its rotation, lies in its
    direction and, if its length is known, at its distance. The best candidates are refined on the geometries that agree
    with them (weighted least squares of the angles to the rays) and scored again. This is translation averaging for one
    camera at a time with several hypotheses per pair, in which a false geometry of a repeated structure is outweighed
    however many matches it has.
    """
    rotations, centers = _candidates(evidence)
    if not len(centers):
        return []
    # A candidate from a single chain has the error of its length, so directions are compared with more tolerance at
    # first.
    agree = agreement(evidence, rotations, centers, loose_rad=float(np.deg2rad(3.0)))
    scores = best_by_partner(evidence.partner, agree * evidence.weight)
    found: list[Placement] = []
    for idx in np.argsort(-scores, kind="stable"):
        if len(found) == most:
            break
        pose = _refined(evidence, agree[idx], centers[idx])
        if any(_same(pose, other.cam_from_world, evidence) for other in found):
            continue
        tight = agreement(evidence, pose.rotation[None], pose.center[None])[0]
        if tight.any():
            pose = _refined(evidence, tight, pose.center)
            tight = agreement(evidence, pose.rotation[None], pose.center[None])[0]
        score = float(best_by_partner(evidence.partner, (tight * evidence.weight)[None])[0])
        if score > 0:
            found.append(Placement(pose, tight, score))
    found.sort(key=lambda placement: -placement.score)
    distinct: list[Placement] = []
    for placement in found:
        if not any(_same(placement.cam_from_world, other.cam_from_world, evidence) for other in distinct):
            distinct.append(placement)
    return distinct


def agreement(
    evidence: PairEvidence, rotations: FloatArray, centers: FloatArray, *, loose_rad: float = 0.0
) -> NDArray[np.bool_]:
    """Return which geometries agree with poses, (C, W), given rotations (C, 3, 3) and centres (C, 3).

    Args:
        evidence: the W geometries.
        rotations: (C, 3, 3) of cam_from_world.
        centers: (C, 3) in the world.
        loose_rad: added to the tolerance of the directions.
    """
    offsets = centers[:, None] - evidence.origins
    distances = np.linalg.norm(offsets, axis=2)
    along = np.einsum("cwi,wi->cw", offsets, evidence.directions)
    across = np.linalg.norm(offsets - along[..., None] * evidence.directions, axis=2)
    angles = np.arctan2(across, along)
    # cos of the angle between rotations A and B is (tr(AᵀB) − 1) / 2.
    traces = np.einsum("cij,wij->cw", rotations, evidence.rotations)
    turned = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = np.abs(np.log(distances / evidence.lengths))
    fits = np.isnan(evidence.lengths) | (stretch < np.log(AGREEING))
    agrees: NDArray[np.bool_] = (
        (angles < evidence.tolerance_rad + loose_rad) & (turned < float(np.deg2rad(2.0))) & fits & (distances > 0)
    )
    return agrees


def _candidates(evidence: PairEvidence) -> tuple[FloatArray, FloatArray]:
    """Return rotations (C, 3, 3) and centres (C, 3) suggested by single chains and by intersecting rays."""
    known = np.flatnonzero(np.isfinite(evidence.lengths))
    rotations = [evidence.rotations[known]]
    centers = [evidence.origins[known] + evidence.lengths[known, None] * evidence.directions[known]]
    open_ended = np.flatnonzero(np.isnan(evidence.lengths))
    if len(open_ended):
        # Number of geometries without known length whose rays are intersected.
        heaviest = np.argsort(-evidence.weight, kind="stable")[:8]
        for a in heaviest:
            for b in heaviest:
                if evidence.partner[a] < evidence.partner[b] and (a in open_ended or b in open_ended):
                    crossing = _crossing(evidence, a, b)
                    if crossing is not None:
                        rotations.append(evidence.rotations[a][None])
                        centers.append(crossing[None])
    return np.concatenate(rotations), np.concatenate(centers)


def _crossing(evidence: PairEvidence, a: np.intp, b: np.intp) -> FloatArray | None:
    """Return the midpoint of two rays at their closest approach, if it is in front of both."""
    u, v = evidence.directions[a], evidence.directions[b]
    gap = evidence.origins[b] - evidence.origins[a]
    normal = np.cross(u, v)
    squared = float(normal @ normal)
    if squared < float(np.sin(np.deg2rad(5.0))) ** 2:
        return None
    along_u, along_v = float(np.cross(gap, v) @ normal) / squared, float(np.cross(gap, u) @ normal) / squared
    if along_u <= 0 or along_v <= 0:
        return None
    point: FloatArray = 0.5 * (evidence.origins[a] + along_u * u + evidence.origins[b] + along_v * v)
    return point


def _refined(evidence: PairEvidence, agree: NDArray[np.bool_], center: FloatArray) -> Rigid3:
    """Return the pose nearest to the rays and rotations that agree, starting from a first centre."""
    if not agree.any():
        return Rigid3.from_center(np.eye(3), center)
    weight = evidence.weight[agree]
    rotation = nearest_rotation(np.einsum("w,wij->ij", weight, evidence.rotations[agree]))
    origins, directions, lengths = evidence.origins[agree], evidence.directions[agree], evidence.lengths[agree]
    outer = directions[:, :, None] * directions[:, None, :]
    for _ in range(2):
        distances = np.maximum(np.linalg.norm(center - origins, axis=1), 1e-12)
        by_angle = weight / (distances * evidence.tolerance_rad[agree]) ** 2
        by_length = np.where(np.isfinite(lengths), weight / (0.05 * distances) ** 2, 0.0)
        matrix = np.einsum("w,wij->ij", by_angle, np.eye(3) - outer) + np.einsum("w,wij->ij", by_length, outer)
        towards = origins + np.where(np.isfinite(lengths), lengths, 0.0)[:, None] * directions
        vector = np.einsum("w,wij,wj->i", by_angle, np.eye(3) - outer, origins)
        vector += np.einsum("w,wij,wj->i", by_length, outer, towards)
        if np.linalg.eigvalsh(matrix)[0] < 1e-9 * np.trace(matrix):
            break
        center = np.linalg.solve(matrix, vector)
    return Rigid3.from_center(rotation, center)


def _same(pose: Rigid3, other: Rigid3, evidence: PairEvidence) -> bool:
    """Return whether two poses are the same, relative to the distances to the partners."""
    nearest = float(np.median(np.linalg.norm(pose.center - evidence.origins, axis=1)))
    cosine = (float(np.sum(pose.rotation * other.rotation)) - 1) / 2
    turned = float(np.arccos(np.clip(cosine, -1, 1)))
    return turned < float(np.deg2rad(1.0)) and float(np.linalg.norm(pose.center - other.center)) < 0.03 * nearest
