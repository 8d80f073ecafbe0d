"""Check the cameras of a model by the images, and correct them: move them, leave them out, or mark them as doubtful."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.resection import points_needed
from pano_mvs.algorithms.poses.verification.aliases import Alias, find_aliases, labellings, moved_cameras
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.belief.evidence import camera_evidence
from pano_mvs.algorithms.poses.verification.belief.verdict import MISS_COST, is_doubtful, is_left_out, reason
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.algorithms.poses.verification.contradictions import contradicted_parts
from pano_mvs.algorithms.poses.verification.joints import Joint, measured_joints
from pano_mvs.geometry import Rigid3, geodesic_angle

# If no more than this can be expected to be confirmed, nothing can be concluded.
_MIN_EXPECTED = 0.1
_BLOCK_ROUNDS = 2
# If the images would confirm hardly less than now, the arrangement is ambiguous.
_AMBIGUOUS_GAIN = -0.2
# If almost every pair of images would agree with the same motion, the place is periodic throughout.
_PERIODIC, _AMBIGUOUS_GAIN_PERIODIC = 0.7, -0.3
_NAMED = 4
_FLIPPED = 3
# Exponent of the share of explained pairs relative to the share of confirmed texture.
PAIRS_POWER = 0.25
_HOPELESS_GAINS = -0.45, -0.1  # of the first image, and of the first two or more; below it no more images are consulted


@dataclass(eq=False)
class CameraChecks:
    """Evidence of the images for or against the cameras of a model."""

    # image position to the confirmed share of its textured pixels; NaN if too little can be judged
    shares: dict[int, float] = field(default_factory=dict)
    # image position to the share that its neighbours suggest; NaN likewise
    expected: dict[int, float] = field(default_factory=dict)
    moved: set[int] = field(default_factory=set)  # images that were moved to another pose
    p_right: dict[int, float] = field(default_factory=dict)  # image position to the probability that its pose is right
    doubts: dict[int, str] = field(default_factory=dict)  # images with a doubtful pose, with the reason
    removed: dict[int, str] = field(default_factory=dict)  # images that were removed from the model, with the reason
    links_contradicting: float = np.nan  # largest share of the weight of learned pairs that contradicted the cameras
    asked: bool = True  # whether the images were consulted


def correct_cameras(
    model: PlacedModel, confirmation: Confirmation, *, fixed: Collection[int] = (), miss_cost: float = MISS_COST
) -> CameraChecks:
    """Check all cameras of a model by the images, and correct those for which another pose explains more.

    Cameras that confirm much less than their neighbours are tried at the other poses that their pairs suggest, against
    cameras that are not suspect. The model is changed in place.

    Args:
        model: a model with two or more cameras.
        confirmation: of the same capture.
        fixed: images that are never moved or removed, only reported as doubtful.
        miss_cost: see `is_doubtful`.
    """
    found = CameraChecks()
    ambiguity = ""
    if not fixed:
        found.moved, ambiguity = _unshift_blocks(model, confirmation)
    for _ in range(3):
        _judge(model, confirmation, found)
        suspects = _suspects(found)
        trusted = {idx: camera for idx, camera in model.cameras.items() if idx not in suspects}
        if len(trusted) < 2:
            trusted = dict(model.cameras)
        moved = False
        for image in suspects:
            if image in fixed:
                continue
            pose = _better_place(model, image, trusted, confirmation=confirmation)
            if pose is not None:
                model.add(image, pose)
                trusted[image] = pose
                found.moved.add(image)
                moved = True
        if not moved:
            break
    else:
        _judge(model, confirmation, found)
    while True:
        _believe(model, found, joints=measured_joints(model, confirmation), miss_cost=miss_cost, ambiguity=ambiguity)
        if not _leave_out_worst(model, found, fixed=fixed, miss_cost=miss_cost):
            return found
        _judge(model, confirmation, found)


def _unshift_blocks(model: PlacedModel, confirmation: Confirmation) -> tuple[set[int], str]:
    """Move blocks of cameras to where the images confirm clearly more.

    Returns:
        The images that were moved, and a description of an ambiguity: a motion of a block after which the images would
        confirm about as much as they do now; "" if there is none.
    """
    moved: set[int] = set()
    for remaining in reversed(range(_BLOCK_ROUNDS + 1)):
        moves = block_moves(model, confirmation)
        if not moves:
            break
        gain, alias, labels = max(moves, key=lambda found: found.gain)
        # A block is moved if the images around the cut confirm this much more. If a first choice of the block loses no
        # more than this, similar blocks are tried.
        if gain > -0.1 and remaining:
            labels, gain = _with_better_labels(model, alias, labels, gain=gain, confirmation=confirmation)
        if gain <= 0.05 or not remaining:
            periodic = len(alias.signed_weights) > _PERIODIC * len(model.chosen)
            limit = _AMBIGUOUS_GAIN_PERIODIC if periodic else _AMBIGUOUS_GAIN
            if gain > limit:
                return moved, _ambiguity(model, alias, labels)
            return moved, next((_turned_ambiguity(other.alias) for other in moves if _turn_deg(other.alias)), "")
        before, after = model.cameras, _with_block_moved(model, alias, labels)
        model.cameras, model.chosen = after.cameras, after.chosen
        model.learn_ranges()
        moved |= {image for image, camera in model.cameras.items() if camera is not before[image]}
    return moved, ""


class BlockMove(NamedTuple):
    """A block of cameras that an alias may have moved."""

    gain: float  # relative gain in agreement of images and pairs if the block is moved
    alias: Alias  # the motion
    labels: dict[int, int]  # image position to 1 for the images of the block, 0 for the others


def block_moves(model: PlacedModel, confirmation: Confirmation) -> list[BlockMove]:
    """Return the moves of blocks that several pairs suggest, each with the gain of making it."""
    return [
        BlockMove(_gain_of(model, alias, labels, confirmation=confirmation), alias, labels)
        for alias in find_aliases(model)
        for labels in labellings(model, alias)
    ]


def _with_block_moved(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> PlacedModel:
    """Return a copy of a model with a block of cameras moved by an alias, and with geometries chosen again."""
    after = model.copy()
    after.cameras = moved_cameras(model, alias, labels)
    after.choose_again()
    after.learn_ranges()
    after.choose_again()
    return after


def _ambiguity(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> str:
    """Return a description of the images that might as well be elsewhere."""
    block = [image for image, label in labels.items() if label]
    rest = [image for image, label in labels.items() if not label]
    smaller = [model.pairs.names[image] for image in min(block, rest, key=len)]
    named = ", ".join(smaller[:_NAMED]) + (" …" if len(smaller) > _NAMED else "")
    after = moved_cameras(model, alias, labels)
    distance = max(float(np.linalg.norm(after[image].center - pose.center)) for image, pose in model.cameras.items())
    turned = f", turned by {_turn_deg(alias):.0f}°" if _turn_deg(alias) else ""
    return (
        f"the place repeats: the images would confirm about as much if {named} were {distance:.2g} units away from "
        f"where they are{turned}, relative to the others"
    )


def _turned_ambiguity(alias: Alias) -> str:
    """Return a warning that part of the capture may be rotated; a few pairs hardly determine which images."""
    return (
        f"the place repeats: {len(alias.signed_weights)} pairs would agree if some of the images were rotated by "
        f"{_turn_deg(alias):.0f}° and placed elsewhere, as in a second, similar room"
    )


def _turn_deg(alias: Alias) -> float:
    """Return the angle by which an alias rotates a block; 0 if it only translates it."""
    turn_deg = float(np.rad2deg(geodesic_angle(alias.turn, np.eye(3))))
    return turn_deg if turn_deg > 5.0 else 0.0


def _with_better_labels(
    model: PlacedModel, alias: Alias, labels: dict[int, int], *, gain: float, confirmation: Confirmation
) -> tuple[dict[int, int], float]:
    """Change the labels of the images that confirm least, one at a time, while that gains; return labels and gain."""
    for _ in range(_FLIPPED):
        cameras = moved_cameras(model, alias, labels)
        shares = {image: confirmation.share(image, pose, cameras) for image, pose in cameras.items()}
        before = gain
        for image in sorted(shares, key=lambda idx: (np.nan_to_num(shares[idx]), idx))[:_FLIPPED]:
            flipped = {**labels, image: 1 - labels[image]}
            if 0 < sum(flipped.values()) < len(flipped):
                flipped_gain = _gain_of(model, alias, flipped, confirmation=confirmation)
                if flipped_gain > gain:
                    labels, gain = flipped, flipped_gain
        if gain == before:
            break
    return labels, gain


def _gain_of(model: PlacedModel, alias: Alias, labels: dict[int, int], *, confirmation: Confirmation) -> float:
    """Return the relative gain in agreement of images and pairs if a block is moved (the factor minus one).

    The factor is the ratio of confirmed shares, times a power of the ratio of explained shares of pairs: repeated
    structure misleads matches more often than images, but an arrangement that the images confirm slightly more and most
    pairs contradict is not the true one either. Only images with most neighbours on the other side of the cut are
    consulted. Images whose neighbours all move with them, or all stay with them, see no difference.
    """
    cameras = moved_cameras(model, alias, labels)
    crossing: dict[int, int] = {}
    for image in model.cameras:
        around = {
            idx
            for poses in (model.cameras, cameras)
            for idx in nearest_cameras(poses[image], {k: pose for k, pose in poses.items() if k != image})
        }
        crossing[image] = sum(labels[idx] != labels[image] for idx in around)
    asked = sorted((image for image in crossing if crossing[image]), key=lambda idx: (-crossing[idx], idx))[:6]
    before = after = gain = 0.0
    for number, image in enumerate(asked):
        before += float(np.nan_to_num(confirmation.share(image, model.cameras[image], model.cameras)))
        after += float(np.nan_to_num(confirmation.share(image, cameras[image], cameras)))
        gain = after / before - 1 if before > 0 else 0.0
        if gain < _HOPELESS_GAINS[min(number, 1)]:
            return gain
    explained = _with_block_moved(model, alias, labels).explained_share() / max(model.explained_share(), 1e-9)
    return float((1 + gain) * explained**PAIRS_POWER - 1)


def check_cameras(model: PlacedModel, confirmation: Confirmation | None) -> CameraChecks:
    """Return the evidence of the images, or of the pairs alone, for the cameras of a model, without changing it."""
    found = CameraChecks(asked=confirmation is not None)
    if confirmation is None:
        found.shares = found.expected = dict.fromkeys(model.cameras, float("nan"))
    else:
        _judge(model, confirmation, found)
    _believe(model, found)
    return found


def _judge(model: PlacedModel, confirmation: Confirmation, found: CameraChecks) -> None:
    """Compare the confirmed share of each image with the share that its nearest neighbours suggest.

    In larger captures the images share their small sweeps. Images whose result is then less than perfect are judged
    again by sweeps of their neighbours without them.
    """
    # With this many cameras or more, the first pass uses shared sweeps; a second one follows below this expected share.
    shared = len(model.cameras) >= 8
    evidence = {
        image: confirmation.evidence(image, pose, model.cameras, independent=not shared)
        for image, pose in sorted(model.cameras.items())
    }
    neighbours = {
        image: nearest_cameras(pose, {idx: camera for idx, camera in model.cameras.items() if idx != image}, count=6)
        for image, pose in model.cameras.items()
    }

    def expected_of(image: int) -> float:
        return evidence[image].expected_share([evidence[idx] for idx in neighbours[image]])

    if shared:
        doubted = [image for image in evidence if evidence[image].share < 0.9 * expected_of(image)]
        for image in doubted:
            evidence[image] = confirmation.evidence(image, model.cameras[image], model.cameras)
    found.shares = {image: own.share for image, own in evidence.items()}
    found.expected = {image: expected_of(image) for image in evidence}


def _suspects(found: CameraChecks) -> list[int]:
    """Return the images that confirm much less than expected, worst first."""
    ratios = {image: share / max(found.expected[image], 1e-9) for image, share in found.shares.items()}
    # A camera is tried at other poses if its images confirm less than this share of what its neighbours suggest.
    return sorted(
        (image for image, ratio in ratios.items() if ratio < 0.75 and found.expected[image] > _MIN_EXPECTED),
        key=lambda image: (ratios[image], image),
    )


def _better_place(
    model: PlacedModel, image: int, trusted: Mapping[int, Rigid3], *, confirmation: Confirmation
) -> Rigid3 | None:
    """Return another pose of an image that the images confirm clearly better than its own; None if there is none."""
    cameras = {idx: camera for idx, camera in trusted.items() if idx != image}
    if len(cameras) < 2:
        return None
    here = confirmation.share(image, model.cameras[image], cameras)
    # Another pose is used if it is better by this factor and by this difference.
    best, best_share = None, max(1.15 * here, here + 0.03)
    for pose in _alternatives(model, image, cameras):
        share = confirmation.share(image, pose, cameras)
        if share > best_share:
            best, best_share = pose, share
    return best


def _alternatives(model: PlacedModel, image: int, cameras: Mapping[int, Rigid3]) -> list[Rigid3]:
    """Return the poses that an image's pairs with some cameras suggest, refined on known points."""
    without = model.copy()
    without.cameras = dict(cameras)
    pair_evidence, places = without.place(image)
    poses = []
    for place in places[:4]:
        # Minimum share of the best placement's score by matches, for a pose to be tried at all.
        if place.score < 0.2 * places[0].score:
            continue
        pose, support, known = without.polished(image, pair_evidence, place)
        if support >= points_needed(known):
            poses.append(pose)
    return poses


def _believe(
    model: PlacedModel,
    found: CameraChecks,
    *,
    joints: Sequence[Joint] = (),
    miss_cost: float = MISS_COST,
    ambiguity: str = "",
) -> None:
    """Find the probability that each camera is right, and the doubts that follow from it."""
    rows = camera_evidence(
        model, found.shares, found.expected, joints=joints, contradicting_before=found.links_contradicting
    )
    contradicting = [row["links_contradicting"] for row in rows.values() if np.isfinite(row["links_contradicting"])]
    found.links_contradicting = max(contradicting, default=found.links_contradicting)
    found.p_right = {image: FITTED.probability(row) for image, row in rows.items()}
    found.doubts = {
        image: reason(FITTED, row, ambiguity=ambiguity)
        for image, row in rows.items()
        if is_doubtful(found.p_right[image], miss_cost=miss_cost)
    }
    _doubt_contradicted_parts(model, found)


def _doubt_contradicted_parts(model: PlacedModel, found: CameraChecks) -> None:
    """Report parts that verified pairs contradict as doubtful, unless the images confirm most of their texture."""
    for part in contradicted_parts(model, found.shares):
        one, other = (model.pairs.names[image] for image in part.pair)
        why = (
            f"{100 * part.share:.0f} % of the evidence of pairs between its part of the capture and the rest "
            f"contradicts their places, most of all that of {one} and {other}: take panoramas in between"
        )
        for image in part.images:
            found.doubts[image] = "; ".join(filter(None, (found.doubts.get(image), why)))


def _leave_out_worst(model: PlacedModel, found: CameraChecks, *, fixed: Collection[int], miss_cost: float) -> bool:
    """Remove the camera that is wrong most surely, if that is sure enough, and those that only it holds.

    The others may have been doubted because of it, so they are to be judged again. At least two are kept.
    """
    worst = min(found.p_right.keys() - fixed, key=lambda image: (found.p_right[image], image), default=None)
    if worst is None or not is_left_out(found.p_right[worst], miss_cost=miss_cost):
        return False
    held = model.held_by([worst])
    if len(model.cameras) - len(held) <= 2:
        return False
    found.removed |= {worst: found.doubts[worst]} | dict.fromkeys(
        held, "its pairs are all with images that were left out"
    )
    for image in (worst, *held):
        model.remove(image)
    return True
