"""Check the cameras of a model by the images, and correct them: move them, leave them out, or mark them as doubtful."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.resection import points_needed
from pano_mvs.algorithms.poses.verification.aliases import other_arrangement
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.belief.doubts import MISS_COST, is_doubtful, is_left_out, reason
from pano_mvs.algorithms.poses.verification.belief.evidence import Row, camera_evidence
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.algorithms.poses.verification.contradictions import contradicted_parts
from pano_mvs.geometry import Rigid3


@dataclass(eq=False)
class CameraChecks:
    """Evidence of the images for or against the cameras of a model."""

    # image position to the confirmed share of its textured pixels; NaN if too little can be judged
    shares: dict[int, float] = field(default_factory=dict)
    # image position to the share that its neighbours suggest; NaN likewise
    expected: dict[int, float] = field(default_factory=dict)
    evidence: dict[int, Row] = field(default_factory=dict)  # image position to all measurements of its camera
    moved: set[int] = field(default_factory=set)  # images that were moved to another pose
    p_right: dict[int, float] = field(default_factory=dict)  # image position to the probability that its pose is right
    doubts: dict[int, str] = field(default_factory=dict)  # images with a doubtful pose, with the reason
    removed: dict[int, str] = field(default_factory=dict)  # images that were removed from the model, with the reason
    links_contradicting: float = np.nan  # largest share of the weight of learned pairs that contradicted the cameras
    asked: bool = True  # whether the images were consulted


def correct_cameras(
    model: PlacedModel, confirmation: Confirmation, *, fixed: Collection[int] = (), miss_cost: float = MISS_COST
) -> CameraChecks:
    """Check all cameras of a model by the images, and correct those for which another pose is more probable.

    Doubtful cameras are tried at the other poses that their pairs suggest, against cameras that are not doubtful. The
    model is changed in place.

    Args:
        model: a model with two or more cameras.
        confirmation: of the same capture.
        fixed: images that are never moved or removed, only reported as doubtful.
        miss_cost: see `is_doubtful`.
    """
    found = CameraChecks()
    _judge(model, confirmation, found)
    _believe(model, found, miss_cost=miss_cost)
    suspects = sorted(
        (image for image, p in found.p_right.items() if image not in fixed and is_doubtful(p, miss_cost=miss_cost)),
        key=lambda image: (found.p_right[image], image),
    )
    trusted = {idx: camera for idx, camera in model.cameras.items() if idx not in suspects}
    if len(trusted) < 2:
        trusted = dict(model.cameras)
    for image in suspects:
        if pose := _more_probable_place(model, image, trusted, confirmation=confirmation, found=found):
            model.add(image, pose)
            trusted[image] = pose
            found.moved.add(image)
    if found.moved:
        found.links_contradicting = np.nan
        _judge(model, confirmation, found)
        _believe(model, found, miss_cost=miss_cost)
    while _leave_out_worst(model, found, fixed=fixed, miss_cost=miss_cost):
        _judge(model, confirmation, found)
        _believe(model, found, miss_cost=miss_cost)
    return found


def check_cameras(model: PlacedModel) -> CameraChecks:
    """Return the evidence of the pairs alone for the cameras of a model, without changing it."""
    found = CameraChecks(asked=False)
    found.shares = found.expected = dict.fromkeys(model.cameras, float("nan"))
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


def _more_probable_place(
    model: PlacedModel, image: int, trusted: Mapping[int, Rigid3], *, confirmation: Confirmation, found: CameraChecks
) -> Rigid3 | None:
    """Return the pose of an image at which it is most probably right; None for its own, or if there is no other."""
    cameras = {idx: camera for idx, camera in trusted.items() if idx != image}
    if len(cameras) < 2:
        return None

    def probability(pose: Rigid3) -> float:
        moved = model.copy()
        moved.add(image, pose)
        shares = {**found.shares, image: confirmation.share(image, pose, cameras)}
        return FITTED.probability(camera_evidence(moved, shares, found.expected, images=[image])[image])

    poses = [model.cameras[image], *_alternatives(model, image, cameras)]
    best = max(poses, key=probability)
    return None if best is poses[0] else best


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


def _believe(model: PlacedModel, found: CameraChecks, *, miss_cost: float = MISS_COST) -> None:
    """Find the probability that each camera is right, and the doubts that follow from it."""
    rows = found.evidence = camera_evidence(
        model, found.shares, found.expected, contradicting_before=found.links_contradicting
    )
    contradicting = [row["links_contradicting"] for row in rows.values() if np.isfinite(row["links_contradicting"])]
    found.links_contradicting = max(contradicting, default=found.links_contradicting)
    found.p_right = {image: FITTED.probability(row) for image, row in rows.items()}
    doubtful = [image for image in rows if is_doubtful(found.p_right[image], miss_cost=miss_cost)]
    ambiguity = other_arrangement(model) if doubtful else ""
    found.doubts = {image: reason(FITTED, rows[image], ambiguity=ambiguity) for image in doubtful}
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
