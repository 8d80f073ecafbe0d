"""Check the cameras of a model by the images, and correct them: move them, leave them out, or mark them as doubtful."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.resection import points_needed
from pano_mvs.algorithms.poses.verification.aliases import other_arrangement
from pano_mvs.algorithms.poses.verification.appearance import Surroundings
from pano_mvs.algorithms.poses.verification.arrangements import is_more_confirmed
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.belief.doubts import MISS_COST, is_doubtful, is_left_out, reason
from pano_mvs.algorithms.poses.verification.belief.evidence import OfImages, Row, camera_evidence, is_same_place
from pano_mvs.algorithms.poses.verification.confirmation import SHARED_FROM, SOURCES, Confirmation, nearest_cameras
from pano_mvs.geometry import Rigid3

_MAX_PLACES = 4  # number of places of an image that are compared, as many as a camera has neighbours in a small sweep


@dataclass(eq=False)
class CameraChecks:
    """Evidence of the images for or against the cameras of a model."""

    of_images: dict[int, OfImages] = field(default_factory=dict)  # image position to what the images say of its camera
    evidence: dict[int, Row] = field(default_factory=dict)  # image position to all measurements of its camera
    moved: set[int] = field(default_factory=set)  # images that were moved to another pose
    p_right: dict[int, float] = field(default_factory=dict)  # image position to the probability that its pose is right
    doubts: dict[int, str] = field(default_factory=dict)  # images with a doubtful pose, with the reason
    removed: dict[int, str] = field(default_factory=dict)  # images that were removed from the model, with the reason
    # models of two or more cameras that a removed one alone held: right among themselves, perhaps, and not checked yet
    split_off: list[PlacedModel] = field(default_factory=list)
    links_contradicting: float = np.nan  # largest share of the weight of learned pairs that contradicted the cameras
    refuted: dict[int, list[Rigid3]] = field(default_factory=dict)  # image position to poses that the images refute
    # doubtful images with another place that the images do not refute, or that was not compared; None: not compared
    undecided: set[int] | None = None
    compared: int = 0  # number of other poses that were compared
    asked: bool = True  # whether the images were consulted


def correct_cameras(
    model: PlacedModel, confirmation: Confirmation, *, fixed: Collection[int] = (), miss_cost: float = MISS_COST
) -> tuple[PlacedModel, CameraChecks]:
    """Check all cameras of a model by the images, and correct those for which the images prefer another pose.

    Doubtful cameras are tried at the other poses that their pairs suggest, and move only if all cameras together are
    confirmed more (see `is_more_confirmed`). A camera that is surely wrong is left out unless others lose by it. Two or
    more cameras that it alone connected to the others are a model of their own from then on.

    Args:
        model: a model with two or more cameras.
        confirmation: of the same capture.
        fixed: images that are never moved or removed, only reported as doubtful.
        miss_cost: see `is_doubtful`.

    Returns:
        The model, another one if cameras were moved or removed, and its checks.
    """
    found = CameraChecks()
    _judge(model, confirmation, found)
    _believe(model, found, miss_cost=miss_cost)
    budget = 2 * len(model.cameras)
    while suspects := _suspects(found, fixed=fixed, miss_cost=miss_cost):
        before = model
        undecided = found.undecided = {*suspects}
        for image in suspects:
            if found.compared < budget and len(model.cameras) > 2:
                undecided.discard(image)
                model = _at_best_place(model, image, confirmation, found=found, undecided=undecided)
        if model is not before:
            found.links_contradicting = np.nan
            found.refuted.clear()
            found.undecided = None
            _judge(model, confirmation, found)
        _believe(model, found, miss_cost=miss_cost)
        if model is before:
            break
    while (left := _without_worst(model, confirmation, found, fixed=fixed, miss_cost=miss_cost)) is not None:
        model = left
        _judge(model, confirmation, found)
        _believe(model, found, miss_cost=miss_cost)
    return model, found


def _suspects(found: CameraChecks, *, fixed: Collection[int], miss_cost: float) -> list[int]:
    """Return the doubtful images that may be moved, the least probable first."""
    doubtful = [image for image, p in found.p_right.items() if is_doubtful(p, miss_cost=miss_cost)]
    return sorted({*doubtful} - {*fixed}, key=lambda image: (found.p_right[image], image))


def _at_best_place(
    model: PlacedModel, image: int, confirmation: Confirmation, *, found: CameraChecks, undecided: set[int]
) -> PlacedModel:
    """Return the model with an image where all cameras together are confirmed most, of the places its pairs suggest.

    The images refute other places if they confirm less of all cameras there. It moves to no place that points refuse.
    """
    others = {idx: camera for idx, camera in model.cameras.items() if idx != image}
    without = model.with_cameras(others)
    evidence, places = without.place(image)
    shares = confirmation.parallax_shares(model.cameras)
    best = model.cameras
    refuted = []
    for place in places[:_MAX_PLACES]:
        pose, support, known = without.polished(image, evidence, place)
        # Minimum share of the best placement's score by matches, for a pose to be compared at all.
        if place.score < 0.2 * places[0].score or is_same_place(pose, model.cameras, image):
            continue
        found.compared += 1
        moved = {**others, image: pose}
        after = confirmation.parallax_shares(moved)
        if is_more_confirmed(shares, after):
            refuted.append(place.cam_from_world)
        elif support >= points_needed(known) and is_more_confirmed(after, shares):
            best, shares = moved, after
        else:
            undecided.add(image)
    found.refuted[image] = refuted
    if best is model.cameras:
        return model
    found.moved.add(image)
    return model.with_cameras(best)


def check_cameras(model: PlacedModel) -> CameraChecks:
    """Return the evidence of the pairs alone for the cameras of a model, without changing it."""
    found = CameraChecks(asked=False)
    _believe(model, found)
    return found


def _judge(model: PlacedModel, confirmation: Confirmation, found: CameraChecks) -> None:
    """Compare the confirmed share of each image with the share that its nearest neighbours suggest.

    Each image is also compared with what the others expect of it. In larger captures the images share their small
    sweeps. Images whose result is then less than perfect are judged again by sweeps of their neighbours without them.
    """
    # The first pass uses shared sweeps; a second one follows below this expected share.
    shared = len(model.cameras) >= SHARED_FROM
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
    surroundings = Surroundings(confirmation, model.cameras, lambda image: confirmation.ranges(image, model.cameras))
    found.of_images = {
        image: OfImages(
            own.share, expected_of(image), own.wide_share, surroundings.appearance(image, model.cameras[image])
        )
        for image, own in evidence.items()
    }


def _believe(model: PlacedModel, found: CameraChecks, *, miss_cost: float = MISS_COST) -> None:
    """Find the probability that each camera is right, and the doubts that follow from it."""
    rows = found.evidence = camera_evidence(
        model,
        found.of_images,
        contradicting_before=found.links_contradicting,
        refuted=found.refuted,
        undecided=found.undecided,
    )
    contradicting = [row["links_contradicting"] for row in rows.values() if np.isfinite(row["links_contradicting"])]
    found.links_contradicting = max(contradicting, default=found.links_contradicting)
    found.p_right = {image: FITTED.probability(row) for image, row in rows.items()}
    doubtful = [image for image in rows if is_doubtful(found.p_right[image], miss_cost=miss_cost)]
    ambiguity = other_arrangement(model) if doubtful else ""
    found.doubts = {image: reason(FITTED, rows[image], ambiguity=ambiguity) for image in doubtful}


def _without_worst(
    model: PlacedModel,
    confirmation: Confirmation,
    found: CameraChecks,
    *,
    fixed: Collection[int],
    miss_cost: float,
) -> PlacedModel | None:
    """Return the model without the camera that is wrong most surely, and without those that only it holds.

    Of these, each that is alone is removed as well; the others are split off.

    It is None if no camera is wrong surely enough, if others would be confirmed less without it, or if fewer than three
    are left. Whether others are confirmed less is only asked where each of them keeps its number of sources: fewer ones
    confirm less, wherever they are. The others may have been doubted because of it, so they are to be judged again.
    """
    worst = min(found.p_right.keys() - fixed, key=lambda image: (found.p_right[image], image), default=None)
    if worst is None or not is_left_out(found.p_right[worst], miss_cost=miss_cost):
        return None
    held = model.groups_held_by([worst])
    gone = {worst, *(image for group in held for image in group)}
    cameras = {image: camera for image, camera in model.cameras.items() if image not in gone}
    if len(cameras) <= 2:
        return None
    if len(cameras) > SOURCES:
        shares, before = confirmation.parallax_shares(cameras), confirmation.parallax_shares(model.cameras)
        if is_more_confirmed({image: share for image, share in before.items() if image not in gone}, shares):
            return None
    alone = {group[0]: "its pairs are all with images that were left out" for group in held if len(group) == 1}
    found.removed |= {worst: found.doubts[worst]} | alone
    found.split_off += [
        model.with_cameras({image: model.cameras[image] for image in group}) for group in held if len(group) > 1
    ]
    return model.with_cameras(cameras)
