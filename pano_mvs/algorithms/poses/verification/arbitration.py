"""Let the images decide between places that the matches support: move cameras, leave them out, or doubt them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, enough_points
from pano_mvs.algorithms.poses.verification.aliases import Alias, find_aliases, labellings, moved_cameras
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.algorithms.poses.verification.pair_weights import pair_shares
from pano_mvs.geometry import Rigid3, geodesic_angle

# A camera whose images confirm less than this share of what its neighbours lead to expect is looked at again …
_SUSPICIOUS = 0.75
# … and is doubtful if no other place does better and it stays below this share …
_DOUBTFUL = 0.55
# … or is left out, if its pairs do not support it either.
_HOPELESS, _MIN_EXPLAINED = 0.3, 0.5
# Of all pairs of a group; below this, a camera that looks right may still be the wrong one.
_MIN_EXPLAINED_IN_ALL = 0.7
# … unless the pairs of the cameras that are not doubted are explained to this share.
_MIN_EXPLAINED_BY_OTHERS = 0.85
# Nobody doubts a camera that confirms this share of what is expected, whatever its pairs say.
_CONFIRMED = 0.9
# A geometry under which two images confirm this share of what they confirm under their best one is likely.
_LIKELY = 0.9
_MOST_PAIRS = 0.75
# A second geometry of this share of the best one's weight is a rival.
_RIVAL = 0.4
# Another place must be better by this factor, and by this much, to be taken; within the factor it is a rival.
_BETTER, _MARGIN = 1.15, 0.03
# Where nothing more than this can be expected to be confirmed, nothing can be said.
_MIN_EXPECTED = 0.1
_NEIGHBOURS = 6
# From this many cameras on the first look is by shared sweeps; a second one follows below this share of the expected.
_MANY, _SECOND_LOOK = 8, 0.9
_ALTERNATIVES = 4
_MIN_SCORE = 0.2  # of the best placement's score by matches, for a place to be tried at all
_ROUNDS = 3
_BLOCK_ROUNDS = 2
# A block is moved if the images around the cut confirm this much more of themselves; where a first choice of the block
# loses no more than this, others like it are tried.
_MIN_BLOCK_GAIN, _PROMISING_GAIN = 0.05, -0.1
# If they would confirm hardly less than now, nobody can tell which is true.
_AMBIGUOUS_GAIN = -0.2
# Where almost every pair of images would agree with the same move, the place is periodic throughout.
_PERIODIC, _AMBIGUOUS_GAIN_PERIODIC = 0.7, -0.3
_NAMED, _NAMED_TURN_DEG = 4, 5.0
_FLIPPED = 3
_ASKED = 6
# How much the share of the pairs that an arrangement explains counts beside the share of the images.
PAIRS_POWER = 0.25
_HOPELESS_GAINS = -0.45, -0.1  # of the first that is asked, and of the first two or more: no more are asked then


@dataclass(eq=False)
class Arbitration:
    """What the images say about the cameras of a model.

    Attributes:
        shares: image position to the confirmed share of its textured pixels; NaN where too little can be judged.
        expected: image position to the share that its neighbours lead to expect; NaN likewise.
        moved: images that were put in another place.
        doubts: images whose pose is doubtful, with the reason.
        removed: images that were taken out of the model, with the reason.
        asked: whether the images were looked at.
    """

    shares: dict[int, float] = field(default_factory=dict)
    expected: dict[int, float] = field(default_factory=dict)
    moved: set[int] = field(default_factory=set)
    doubts: dict[int, str] = field(default_factory=dict)
    removed: dict[int, str] = field(default_factory=dict)
    asked: bool = True

    def mean_share(self) -> float:
        """Return the mean confirmed share of the images that can be judged; NaN if there is none."""
        known = [share for share in self.shares.values() if np.isfinite(share)]
        return float(np.mean(known)) if known else float("nan")


def arbitrate(
    model: PlacedModel, confirmation: Confirmation, *, fixed: Collection[int] = (), remove: bool = True
) -> Arbitration:
    """Judge all cameras of a model by the images, and put right what another place explains better.

    Cameras that confirm much less than their neighbours are tried in the other places that their pairs suggest,
    against cameras that are beyond suspicion. The model is changed in place.

    Args:
        model: at least two cameras.
        confirmation: of the same capture.
        fixed: images that are never moved or removed, only doubted.
        remove: whether a camera that nothing explains is taken out of the model.
    """
    found = Arbitration()
    ambiguity = ""
    if not fixed:
        found.moved, ambiguity = _unshift_blocks(model, confirmation)
    for _ in range(_ROUNDS):
        _judge(model, confirmation, found)
        suspects = _suspects(found)
        trusted = {idx: camera for idx, camera in model.cameras.items() if idx not in suspects}
        if len(trusted) < 2:
            trusted = dict(model.cameras)
        moved = False
        for image in suspects:
            if image in fixed:
                continue
            pose = _better_place(model, image, trusted, confirmation)
            if pose is not None:
                model.add(image, pose)
                trusted[image] = pose
                found.moved.add(image)
                moved = True
        if not moved:
            break
    _judge(model, confirmation, found)
    _conclude(model, confirmation, found, fixed=fixed, remove=remove)
    for doubt in filter(None, (ambiguity, _contradiction(model, found.doubts))):
        for image in model.cameras:
            found.doubts[image] = "; ".join(filter(None, (found.doubts.get(image), doubt)))
    return found


def _contradiction(model: PlacedModel, doubted: Collection[int]) -> str:
    """Say so if the pairs contradict one another so much that no arrangement can be relied on.

    A single wrong camera contradicts all of its pairs. So nothing is said if the pairs agree well once the cameras that
    are doubted already are left aside.
    """
    explained, by_others = model.explained_share(), model.explained_share(without=doubted)
    if len(model.cameras) < 3 or explained >= _MIN_EXPLAINED_IN_ALL or by_others >= _MIN_EXPLAINED_BY_OTHERS:
        return ""
    return f"only {100 * explained:.0f} % of all pairs, by weight, agree with one arrangement of the cameras"


def _unshift_blocks(model: PlacedModel, confirmation: Confirmation) -> tuple[set[int], str]:
    """Move blocks of cameras that the images confirm clearly better elsewhere.

    Returns:
        The images that were moved, and what is ambiguous: a move of a block after which the images would confirm about
        as much as they do now; "" if there is none.
    """
    moved: set[int] = set()
    for remaining in reversed(range(_BLOCK_ROUNDS + 1)):
        aliases = find_aliases(model)
        gains = [
            (_gain_of(model, alias, labels, confirmation), alias, labels)
            for alias in aliases
            for labels in labellings(model, alias)
        ]
        if not gains:
            break
        gain, alias, labels = max(gains, key=lambda found: found[0])
        if gain > _PROMISING_GAIN and remaining:
            labels, gain = _with_better_labels(model, alias, labels, gain, confirmation)
        if gain <= _MIN_BLOCK_GAIN or not remaining:
            periodic = len(alias.votes) > _PERIODIC * len(model.chosen)
            limit = _AMBIGUOUS_GAIN_PERIODIC if periodic else _AMBIGUOUS_GAIN
            if gain > limit:
                return moved, _ambiguity(model, alias, labels)
            return moved, next((_turned_ambiguity(other) for other in aliases if _turn_deg(other)), "")
        before, after = model.cameras, _with_block_moved(model, alias, labels)
        model.cameras, model.chosen = after.cameras, after.chosen
        model.learn_ranges()
        moved |= {image for image, camera in model.cameras.items() if camera is not before[image]}
    return moved, ""


def _with_block_moved(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> PlacedModel:
    """Return a copy of a model with a block of cameras moved by an alias, and the geometries that agree then."""
    after = model.copy()
    after.cameras = moved_cameras(model, alias, labels)
    after.choose_again()
    after.learn_ranges()
    after.choose_again()
    return after


def _ambiguity(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> str:
    """Say which images might as well stand elsewhere."""
    block = [image for image, label in labels.items() if label]
    rest = [image for image, label in labels.items() if not label]
    smaller = [model.pairs.names[image] for image in min(block, rest, key=len)]
    named = ", ".join(smaller[:_NAMED]) + (" …" if len(smaller) > _NAMED else "")
    after = moved_cameras(model, alias, labels)
    distance = max(float(np.linalg.norm(after[image].center - pose.center)) for image, pose in model.cameras.items())
    turned = f", turned by {_turn_deg(alias):.0f}°" if _turn_deg(alias) else ""
    return (
        f"the place repeats: the images would confirm about as much if {named} stood {distance:.2g} units away from "
        f"where they are{turned}, relative to the others"
    )


def _turned_ambiguity(alias: Alias) -> str:
    """Say that a part of the capture may be turned; which images it has is hardly known from a few pairs."""
    return (
        f"the place repeats: {len(alias.votes)} pairs would agree if some of the images were turned by "
        f"{_turn_deg(alias):.0f}° and stood elsewhere, as in a second room like the first"
    )


def _turn_deg(alias: Alias) -> float:
    """Return by how much an alias turns a block; 0 if it only moves it."""
    turn_deg = float(np.rad2deg(geodesic_angle(alias.turn, np.eye(3))))
    return turn_deg if turn_deg > _NAMED_TURN_DEG else 0.0


def _with_better_labels(
    model: PlacedModel, alias: Alias, labels: dict[int, int], gain: float, confirmation: Confirmation
) -> tuple[dict[int, int], float]:
    """Change the labels of the images that confirm least, one after the other, as long as that gains; return both."""
    for _ in range(_FLIPPED):
        cameras = moved_cameras(model, alias, labels)
        shares = {image: confirmation.share(image, pose, cameras) for image, pose in cameras.items()}
        before = gain
        for image in sorted(shares, key=lambda idx: (np.nan_to_num(shares[idx]), idx))[:_FLIPPED]:
            flipped = {**labels, image: 1 - labels[image]}
            if 0 < sum(flipped.values()) < len(flipped):
                flipped_gain = _gain_of(model, alias, flipped, confirmation)
                if flipped_gain > gain:
                    labels, gain = flipped, flipped_gain
        if gain == before:
            break
    return labels, gain


def _gain_of(model: PlacedModel, alias: Alias, labels: dict[int, int], confirmation: Confirmation) -> float:
    """Return by how much better images and pairs agree when a block is moved, as a factor less one.

    The factor is that of the share that images confirm of themselves, times a power of the factor of the share of the
    pairs that are explained: repeats lead matches astray more often than images, but an arrangement that the images
    confirm a little more and most pairs contradict is not the true one either. The images that have most neighbours on
    the other side of the cut are asked. Those whose neighbours all move with them, or all stay with them, see no
    difference.
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
    asked = sorted((image for image in crossing if crossing[image]), key=lambda idx: (-crossing[idx], idx))[:_ASKED]
    before = after = gain = 0.0
    for number, image in enumerate(asked):
        before += float(np.nan_to_num(confirmation.share(image, model.cameras[image], model.cameras)))
        after += float(np.nan_to_num(confirmation.share(image, cameras[image], cameras)))
        gain = after / before - 1 if before > 0 else 0.0
        if gain < _HOPELESS_GAINS[min(number, 1)]:
            return gain
    explained = _with_block_moved(model, alias, labels).explained_share() / max(model.explained_share(), 1e-9)
    return float((1 + gain) * explained**PAIRS_POWER - 1)


def judge(model: PlacedModel, confirmation: Confirmation | None) -> Arbitration:
    """Return what the images, or without them the pairs alone, say about the cameras of a model; nothing is changed."""
    found = Arbitration(asked=confirmation is not None)
    if confirmation is None:
        found.shares = found.expected = dict.fromkeys(model.cameras, float("nan"))
    else:
        _judge(model, confirmation, found)
    _conclude(model, confirmation, found, fixed=range(len(model.pairs.names)), remove=False)
    return found


def _judge(model: PlacedModel, confirmation: Confirmation, found: Arbitration) -> None:
    """Compare what each image confirms with what its nearest neighbours' experience leads to expect.

    In larger captures the images share their small sweeps; those that then look less than perfect are judged again by
    sweeps of their neighbours without them.
    """
    shared = len(model.cameras) >= _MANY
    evidence = {
        image: confirmation.evidence(image, pose, model.cameras, independent=not shared)
        for image, pose in sorted(model.cameras.items())
    }
    neighbours = {
        image: nearest_cameras(pose, {idx: camera for idx, camera in model.cameras.items() if idx != image},
                               count=_NEIGHBOURS)
        for image, pose in model.cameras.items()
    }  # fmt: skip

    def expected_of(image: int) -> float:
        return evidence[image].expected_share([evidence[idx] for idx in neighbours[image]])

    if shared:
        doubted = [image for image in evidence if evidence[image].share < _SECOND_LOOK * expected_of(image)]
        for image in doubted:
            evidence[image] = confirmation.evidence(image, model.cameras[image], model.cameras)
    found.shares = {image: own.share for image, own in evidence.items()}
    found.expected = {image: expected_of(image) for image in evidence}


def _suspects(found: Arbitration) -> list[int]:
    """Return the images that confirm much less than expected, the worst first."""
    ratios = {image: share / max(found.expected[image], 1e-9) for image, share in found.shares.items()}
    return sorted(
        (image for image, ratio in ratios.items() if ratio < _SUSPICIOUS and found.expected[image] > _MIN_EXPECTED),
        key=lambda image: (ratios[image], image),
    )


def _better_place(
    model: PlacedModel, image: int, trusted: Mapping[int, Rigid3], confirmation: Confirmation
) -> Rigid3 | None:
    """Return another pose of an image that the images confirm clearly better than its own, or None."""
    cameras = {idx: camera for idx, camera in trusted.items() if idx != image}
    if len(cameras) < 2:
        return None
    here = confirmation.share(image, model.cameras[image], cameras)
    best, best_share = None, max(_BETTER * here, here + _MARGIN)
    for pose in _alternatives(model, image, cameras):
        share = confirmation.share(image, pose, cameras)
        if share > best_share:
            best, best_share = pose, share
    return best


def _alternatives(model: PlacedModel, image: int, cameras: Mapping[int, Rigid3]) -> list[Rigid3]:
    """Return the poses that an image's pairs with some cameras suggest, polished on known points."""
    without = model.copy()
    without.cameras = dict(cameras)
    witnesses, places = without.place(image)
    poses = []
    for place in places[:_ALTERNATIVES]:
        if place.score < _MIN_SCORE * places[0].score:
            continue
        pose, support, known = without.polished(image, witnesses, place)
        if enough_points(support, known):
            poses.append(pose)
    return poses


def _conclude(
    model: PlacedModel,
    confirmation: Confirmation | None,
    found: Arbitration,
    *,
    fixed: Collection[int],
    remove: bool,
) -> None:
    """Doubt or take out what is still confirmed much less than expected, or what its own pairs contradict."""
    for image, share in found.shares.items():
        expected, explained = found.expected[image], model.explained_share_of(image)
        ratio = share / expected if expected > _MIN_EXPECTED else float("nan")
        reasons = []
        # Images and pairs may each be short of what makes a camera doubtful, and both speak against it.
        if ratio < (_SUSPICIOUS if explained < _MIN_EXPLAINED_IN_ALL else _DOUBTFUL):
            reasons.append(
                f"other images confirm {100 * share:.0f} % of its texture, where its neighbours lead to expect "
                f"{100 * expected:.0f} %"
            )
        contradicted = explained < _MIN_EXPLAINED and not ratio > _CONFIRMED
        if contradicted and not _confirmed_by_pairs(model, image, confirmation):
            reasons.append(f"only {100 * explained:.0f} % of its pairs, by weight, agree with its place")
        if not reasons:
            continue
        removable = remove and image not in fixed and len(model.cameras) - len(found.removed) > 2
        if removable and ratio < _HOPELESS and explained < _MIN_EXPLAINED:
            found.removed[image] = "; ".join(reasons)
        else:
            found.doubts[image] = "; ".join(reasons)
    _doubt_pairs_alone(model, found)
    for image in found.removed:
        model.remove(image)
        del found.shares[image], found.expected[image]


def _confirmed_by_pairs(model: PlacedModel, image: int, confirmation: Confirmation | None) -> bool:
    """Return whether most pairs of a camera have a geometry that agrees with it, and the images speak for these.

    Repeats may give false geometries more matches than the true ones have.
    """
    if confirmation is None:
        return False
    partners = [idx for idx in model.pairs.partners[image] if idx in model.cameras]
    agreeing = sum((min(image, idx), max(image, idx)) in model.chosen for idx in partners)
    if agreeing < _MOST_PAIRS * len(partners):
        return False
    asked = confirmed = 0
    for partner in partners[:_NEIGHBOURS]:
        edge = min(image, partner), max(image, partner)
        shares = pair_shares(edge, model.pairs.geometries[edge], confirmation)
        asked += 1
        confirmed += edge in model.chosen and shares[model.chosen[edge]] >= _LIKELY * max(shares)
    return 2 * confirmed > asked


def _doubt_pairs_alone(model: PlacedModel, found: Arbitration) -> None:
    """Doubt two cameras that stand alone with several geometries, of which nothing else can tell the true one."""
    if len(model.cameras) != 2:
        return
    first, second = sorted(model.cameras)
    geometries = model.pairs.geometries.get((first, second), ())
    if len(geometries) > 1 and geometries[1].weight > _RIVAL * geometries[0].weight:
        for image in (first, second):
            found.doubts[image] = (
                f"its only pair has another geometry that {len(geometries[1].view)} matches support "
                f"({len(geometries[0].view)} support the one that was taken): take panoramas in between"
            )
