"""Poses from the relative rotations and directions of all pairs, by linear least squares."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.api import All, Context, Names, Panorama, Params, Poses, Rigid3, RunStoppedError, TwoView, stage

FloatArray = NDArray[np.float64]
Pair = tuple[str, str]


class DirectionsParams(Params):
    """Settings of poses.directions."""

    min_matches: int = Field(default=30, ge=5, description="minimum number of verified matches of a pair")


@stage("poses.directions")
def directions(images: Names[Panorama], matches: All[TwoView], params: DirectionsParams, ctx: Context) -> Poses:
    """Solve all rotations along the strongest pairs, and then all positions together from the directions of the pairs.

    Each direction d from one camera to another requires (1 - d dᵀ)(c₂ - c₁) = 0. The positions are the solution that
    minimises the sum of squares; its scale is free.
    """
    pairs = {
        pair: found
        for pair, found in matches.items()
        if found.geometry == "general" and len(found.matches_idx) >= params.min_matches
    }
    rotations = solve_rotations(pairs)
    rejected = {name: "no pair connects it to the other images" for name in images if name not in rotations}
    for name, reason in rejected.items():
        ctx.reject(name, reason)
    if len(rotations) < 2:
        raise RunStoppedError("no pair has enough matches. Take panoramas closer together, or lower min_matches")
    names = [name for name in images if name in rotations]
    kept = {pair: found for pair, found in pairs.items() if set(pair) <= rotations.keys()}
    centers = solve_centers(names, rotations, kept)
    first = Rigid3.from_center(rotations[names[0]], centers[0])  # its camera becomes the world
    unit = np.linalg.norm(centers[1] - centers[0])
    poses = {}
    for name, center in zip(names, centers, strict=True):
        pose = Rigid3.from_center(rotations[name], center) @ first.inverse()
        poses[name] = Rigid3(pose.rotation, pose.translation / unit)
    ctx.metric("registered", len(names) / len(images))
    return Poses.without_points(
        poses, rejected=rejected, frame="the first registered camera", scale="the first baseline is 1", metric=False
    )


def solve_rotations(pairs: Mapping[Pair, TwoView]) -> dict[str, FloatArray]:
    """Return cam_from_world of the largest connected set of images, chained along the pairs with most matches."""
    groups: list[dict[str, FloatArray]] = [
        {name: np.eye(3)} for name in {name: None for pair in pairs for name in pair}
    ]
    for (first, second), found in sorted(pairs.items(), key=lambda each: -len(each[1].matches_idx)):
        one, other = (next(group for group in groups if name in group) for name in (first, second))
        if one is other:
            continue
        # Turn the world of the second group into that of the first.
        second_from_world = found.rotation @ one[first]
        turn = other[second].T @ second_from_world
        one.update({name: rotation @ turn for name, rotation in other.items()})
        groups.remove(other)
    return max(groups, key=len, default={})


def solve_centers(names: list[str], rotations: Mapping[str, FloatArray], pairs: Mapping[Pair, TwoView]) -> FloatArray:
    """Return the camera centres (N, 3) up to scale; the first is at the origin."""
    column = {name: 3 * idx for idx, name in enumerate(names)}
    rows, ahead = [], np.zeros(3 * len(names))
    for (first, second), found in pairs.items():
        # x_second = R x_first + t: the second camera is at -Rᵀt in the frame of the first.
        direction = -rotations[first].T @ found.rotation.T @ found.direction
        row = np.zeros((3, 3 * len(names)))
        across = np.eye(3) - np.outer(direction, direction)
        row[:, column[second] : column[second] + 3] = across
        row[:, column[first] : column[first] + 3] = -across
        rows.append(row)
        ahead[column[second] : column[second] + 3] += direction
        ahead[column[first] : column[first] + 3] -= direction
    system = np.concatenate(rows)[:, 3:]
    _, values, vectors = np.linalg.svd(system)
    if len(values) > 1 and (len(values) < system.shape[1] or values[-2] < 1e-6 * values[0]):
        raise RunStoppedError("the pairs do not determine the positions: all cameras on one line, or too few pairs")
    centers = np.concatenate([np.zeros(3), vectors[-1]])
    sign = 1.0 if centers @ ahead > 0 else -1.0  # the second camera of each pair is ahead, not behind
    result: FloatArray = (sign * centers).reshape(-1, 3)
    return result
