"""Compare whole arrangements of a capture by what the images confirm."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pano_mvs.algorithms.poses.verification.appearance import Appearance
from pano_mvs.algorithms.poses.verification.confirmation import SHARED_FROM, Confirmation, Evidence
from pano_mvs.geometry import Rigid3

SHARE_STD = 0.02
"""Standard deviation of a camera's confirmed share between two arrangements that are both right: .019 for 91 cameras of
13 captures, solved and true poses."""
CHANCE_SHARE = 0.08
"""What others confirm of a camera in a wrong place: .036 in the median and .073 at most, of 80 in 25 drawn captures; of
124 right cameras, .085 at least. Measured at 256 columns."""

_PLACE_WEIGHTS = {"share": 7.0, "agreement": 3.4, "correlation": 2.1, "cover": -2.0}
"""Of 131 blocks of true cameras in 74 drawn captures, the best place is right for 80 % by the share, for 84 % by these
weights, and for 91 % by those of most likelihood there: 3.6, 3.4, 2.1 and -3.9. But models do not grow from true blocks
alone: of 94 cameras of six large captures that repeat, the latter place 54 rightly, the share 61, and these weights,
which are between both, 65."""


def place_score(share: float, appearance: Appearance) -> float:
    """Return how far what an image shows is for a place, to be compared with that of other places alone.

    Args:
        share: of what it sees there, confirmed by its nearest cameras; 0 if this was not measured.
        appearance: of the image there. The more cameras expect of it, the less agreement says.
    """
    measured: dict[str, float] = {"share": share, **appearance._asdict()}
    return sum(weight * measured[name] for name, weight in _PLACE_WEIGHTS.items())


def is_better_arrangement(
    cameras: Mapping[int, Rigid3], before: Mapping[int, Rigid3], confirmation: Confirmation
) -> bool:
    """Return whether the images confirm one arrangement more than another one, which may have other cameras.

    Cameras that are confirmed no more than by chance count as if they were not placed: another source makes any map
    better, even a source in a wrong place. What has no parallax does not count: cameras of bays that look alike, put
    into one bay, are so near to one another that much is confirmed, and little seen under a parallax.
    """
    return is_more_confirmed(*(_beyond_chance(each, confirmation) for each in (cameras, before)))


def _beyond_chance(cameras: Mapping[int, Rigid3], confirmation: Confirmation) -> dict[int, float]:
    evidence = _evidence_of(cameras, confirmation)
    placed = {image: pose for image, pose in cameras.items() if not evidence[image].share < CHANCE_SHARE}
    if len(placed) < len(cameras):
        evidence = _evidence_of(placed, confirmation)
    return {image: own.parallax_share for image, own in evidence.items()}


def _evidence_of(cameras: Mapping[int, Rigid3], confirmation: Confirmation) -> dict[int, Evidence]:
    """Return what the images confirm of every camera.

    Of few cameras, each is confirmed by maps that are swept without it: in shared ones it would confirm itself.
    """
    independent = len(cameras) < SHARED_FROM
    return {
        image: confirmation.evidence(image, pose, cameras, independent=independent)
        for image, pose in sorted(cameras.items())
    }


def is_more_confirmed(shares: Mapping[int, float], before: Mapping[int, float]) -> bool:
    """Return whether the images confirm one arrangement more than another, by more than its noise.

    All cameras count, on the same pixels: what one camera gains in another place, others may lose by it. A camera that
    only one of the arrangements has confirms nothing in the other. Structure that repeats lets one camera look better
    in a wrong place, but hardly all of them together.

    Args:
        shares: image position to the confirmed share of what it sees under a parallax; NaN counts as nothing.
        before: those of the other arrangement.
    """
    images = sorted(shares.keys() | before.keys())
    gains = np.array([np.nan_to_num(shares.get(idx, 0.0)) - np.nan_to_num(before.get(idx, 0.0)) for idx in images])
    return bool(gains.sum() > 2 * SHARE_STD * np.sqrt(np.count_nonzero(np.abs(gains) > 1e-6)))
