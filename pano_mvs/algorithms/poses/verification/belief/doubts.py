"""Which cameras are doubted, and the sentence that says why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.core.text import plural
from pano_mvs.scene import Poses

MISS_COST = 5.0
"""Cost of a wrong camera that is not doubted, relative to that of a right one that is."""

_CLOSER, _BETWEEN = "take panoramas closer to one another there", "take panoramas in between"
_Row = Mapping[str, float]

# For each measurement: what it says, what is said if it is missing ("" for nothing), and what to do.
_SAID: dict[str, tuple[Callable[[_Row], str], str, str]] = {
    "ratio": (
        lambda row: (
            f"other images confirm {_percent(row['share'])} of its texture, but its neighbours suggest "
            f"{_percent(row['share'] / max(row['ratio'], 1e-9))}"
        ),
        "too little of what it sees has texture that other images could confirm",
        _CLOSER,
    ),
    "share": (
        lambda row: f"other images confirm only {_percent(row['share'])} of its texture",
        "too little of what it sees has texture that other images could confirm",
        _CLOSER,
    ),
    "wide_share": (
        lambda row: f"other images confirm only {_percent(row['wide_share'])} of what it sees under more than 30°",
        "",
        _CLOSER,
    ),
    "likeness": (
        lambda row: (
            f"what it shows is correlated by {max(-row['likeness'], 0.0):.2f} less with what other images lead "
            "to expect there than in the mean of the other cameras"
        ),
        "",
        _CLOSER,
    ),
    "unlike": (
        lambda row: f"{_percent(row['unlike'])} of what it shows is unlike what other images lead to expect there",
        "",
        _CLOSER,
    ),
    "contradicted": (
        lambda row: f"{_percent(row['contradicted'])} of the weight of its pairs contradicts its place",
        "",
        _BETWEEN,
    ),
    "pairs_contradicting": (
        lambda row: f"{_percent(row['pairs_contradicting'])} of the weight of all pairs contradicts the cameras",
        "",
        _BETWEEN,
    ),
    "agreeing": (
        lambda row: (
            f"only {row['agreeing']:.0f} {plural(round(row['agreeing']), 'pair agrees', 'pairs agree')} with its place"
        ),
        "no pair with another image is known",
        _BETWEEN,
    ),
    "scale_worst": (
        lambda row: (
            f"its pairs contradict its distances to other cameras by {_percent(np.expm1(row['scale_worst']), 1)}"
        ),
        "no points that three images see determine its distances to other cameras",
        _BETWEEN,
    ),
    "repeats": (
        lambda row: (
            f"the place repeats: most pairs would agree with other geometries, with {_percent(row['repeats'])} "
            "of the weight of those in use"
        ),
        "no pair agrees with the cameras",
        _BETWEEN,
    ),
    "place_rival": (
        lambda row: (
            f"its pairs would place it elsewhere with {_percent(row['place_rival'])} of the weight that its place has"
        ),
        "no third image determines its place",
        _BETWEEN,
    ),
    "linked": (
        lambda row: (
            f"the learned pairs that connect it with the others weigh only {max(row['linked'], 0.0):.1f} times as much "
            "as one that is just accepted"
        ),
        "",
        _BETWEEN,
    ),
    "links_contradicting": (
        lambda row: (
            f"{_percent(row['links_contradicting'])} of the weight of the group's learned pairs contradicts its cameras"
        ),
        "",
        _BETWEEN,
    ),
}


def is_doubtful(probability: float, *, miss_cost: float = MISS_COST) -> bool:
    """Return whether a camera with this probability to be right is doubted: the smaller expected cost decides."""
    return probability < miss_cost / (1 + miss_cost)


def is_left_out(probability: float, *, miss_cost: float = MISS_COST) -> bool:
    """Return whether a doubtful camera is left out: as surely wrong as one without a doubt is right."""
    return is_doubtful(probability, miss_cost=miss_cost) and not is_doubtful(1 - probability, miss_cost=miss_cost)


def probability_of(poses: Poses) -> dict[str, float]:
    """Return the probability that each camera is right; without one, that of a camera of which nothing was measured."""
    known = poses.right_probabilities
    values = np.full(len(poses.names), np.nan) if known is None else known
    return dict(zip(poses.names, np.where(np.isfinite(values), values, FITTED.probability({})).tolist(), strict=True))


def with_later_evidence(
    poses: Poses, evidence: Mapping[str, tuple[float, str]], *, miss_cost: float = MISS_COST
) -> Poses:
    """Return poses whose probabilities and doubts take account of what was measured after they were verified.

    Args:
        poses: of any origin.
        evidence: image name to the likelihood of what was measured if the pose is right, relative to that if it is
            wrong, and a sentence that says what it is.
        miss_cost: see `is_doubtful`.
    """
    if not evidence.keys() & {*poses.names}:
        return poses
    before = probability_of(poses)
    known = poses.right_probabilities
    probabilities = np.full(len(poses.names), np.nan) if known is None else known.copy()
    doubts = dict(poses.doubts)
    for idx, name in enumerate(poses.names):
        if name in evidence:
            ratio, why = evidence[name]
            odds = ratio * before[name] / max(1 - before[name], 1e-12)
            probabilities[idx] = odds / (1 + odds)
            if is_doubtful(probabilities[idx], miss_cost=miss_cost):
                earlier = poses.doubts.get(name, "").removeprefix(_stated(before[name]))
                doubts[name] = _stated(probabilities[idx]) + "; ".join(filter(None, (why, earlier)))
    return replace(poses, right_probabilities=probabilities, doubts=doubts)


def reason(model: Model, row: Mapping[str, float], *, ambiguity: str = "") -> str:
    """Return why a camera is doubted: its probability, the two measurements that lower it most, and what to do.

    Args:
        model: the fitted model.
        row: the evidence for the camera.
        ambiguity: description of another arrangement that many pairs would agree with; "" if none is known.
    """
    lost = {
        name: value
        for name, value in model.contributions(row).items()
        if value < 0 and (np.isfinite(row.get(name, np.nan)) or _SAID[name][1])
    }
    if "ratio" in lost:  # both are about what other images confirm
        lost["ratio"] += lost.pop("share", 0.0)
    worst = sorted(lost, key=lambda name: (lost[name], name))[:2]
    said = [_SAID[name][0](row) if np.isfinite(row.get(name, np.nan)) else _SAID[name][1] for name in worst]
    advice = ", or ".join(dict.fromkeys(_SAID[name][2] for name in worst))
    why = ", and ".join(dict.fromkeys(filter(None, said))) or "nothing speaks against it, but miss_cost demands more"
    return _stated(model.probability(row)) + "; ".join(filter(None, (why, ambiguity, advice)))


def _stated(probability: float) -> str:
    return f"its pose is right with a probability of {_percent(probability)}: "


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"
