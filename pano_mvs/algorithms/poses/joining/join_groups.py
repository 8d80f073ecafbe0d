"""Join the models of groups that verified pairs connect, but through too few points for one camera at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pano_mvs.algorithms.poses.joining.alignment import Alignment, align_models
from pano_mvs.algorithms.poses.joining.models import are_apart, cross_matches, joined_model
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.geometry import Rigid3, geodesic_angle

_THRESHOLD_RAD = float(np.deg2rad(0.4))
_MIN_WITNESSES, _MIN_SHARE, _MAX_LOG10_FALSE_ALARMS = 10, 0.5, -10.0
_MAX_TURN_STD_DEG, _MAX_OFFSET_STD_DEG, _MAX_SCALE_STD = 1.0, 3.0, 0.1
_MIN_OF_RIVAL = 0.5  # of the witnesses of an alignment; a rival with more makes it ambiguous
_SAME_TURN_RAD = float(np.deg2rad(2.0))


def join_models(models: Sequence[PlacedModel]) -> list[tuple[PlacedModel, tuple[int, ...]]]:
    """Return the models after joining those that their pairs align, each with the positions of its parts.

    An image is added to a growing model only if enough of its points are known there. A door may show too few of them
    to any one image, but all pairs between two models together determine how these lie.

    Args:
        models: of the same pairs, without common images; the world of the largest part is kept.
    """
    left: list[tuple[PlacedModel, tuple[int, ...]]] = [(model, (number,)) for number, model in enumerate(models)]
    while True:
        found = []
        for b in range(len(left)):
            for a in range(b):
                large, small = sorted((a, b), key=lambda idx: (-len(left[idx][0].cameras), idx))
                alignment = _alignment(left[large][0], left[small][0])
                if alignment is not None:
                    found.append((-alignment.witnesses, large, small, alignment))
        if not found:
            return left
        _, large, small, alignment = min(found, key=lambda item: item[:3])
        joined = joined_model(left[large][0], left[small][0], alignment.first_from_second)
        joined.choose_again()
        parts = tuple(sorted((*left[large][1], *left[small][1])))
        left = [one for idx, one in enumerate(left) if idx not in (large, small)]
        left.append((joined, parts))


def _alignment(first: PlacedModel, second: PlacedModel) -> Alignment | None:
    """Return the alignment of two models by the pairs between them; None if these do not determine it."""
    relative, alignment = _aligned(first, second)
    if (
        alignment is None
        or alignment.witnesses < _MIN_WITNESSES
        or alignment.log10_false_alarms > _MAX_LOG10_FALSE_ALARMS
        or alignment.inliers.mean() < _MIN_SHARE
        or alignment.rotation_std_deg > _MAX_TURN_STD_DEG
        or alignment.offset_std_deg > _MAX_OFFSET_STD_DEG
        or alignment.scale_std > _MAX_SCALE_STD
        or not _most_agree(alignment, relative)
        or _has_rival(alignment, first, second)
    ):
        return None
    return alignment


def _has_rival(alignment: Alignment, first: PlacedModel, second: PlacedModel) -> bool:
    """Return whether the runner-up geometries of the pairs put the second model elsewhere, nearly as well supported.

    Where structure repeats, the pairs of two groups agree on several alignments, and the best one may be false.
    """
    _, other = _aligned(first, second, runners_up=True)
    if other is None or other.witnesses < _MIN_OF_RIVAL * alignment.witnesses:
        return False
    return are_apart((alignment.first_from_second, other.first_from_second), first, second)


def _aligned(
    first: PlacedModel, second: PlacedModel, *, runners_up: bool = False
) -> tuple[dict[tuple[int, int], Rigid3], Alignment | None]:
    """Return the relative poses of the pairs between two models in the worlds' axes, and the alignment by them.

    Args:
        first: a model.
        second: another model.
        runners_up: use the second geometry of each pair, of those that have one, instead of the best.
    """
    found, relative = {}, {}
    for edge, geometries in first.pairs.geometries.items():
        for one, other in (edge, edge[::-1]):
            if one in first.cameras and other in second.cameras and len(geometries) > runners_up:
                view, swapped = geometries[int(runners_up)].view, one > other
                pose = Rigid3(view.rotation, view.direction)
                pose = pose.inverse() if swapped else pose
                turn = second.cameras[other].rotation.T
                relative[one, other] = Rigid3(
                    turn @ pose.rotation @ first.cameras[one].rotation, turn @ pose.translation
                )
                found[one, other] = view.matches_idx[:, ::-1] if swapped else view.matches_idx
    matches = cross_matches(first, second, found) if found else None
    if matches is None or not matches.known.any():
        return relative, None
    return relative, align_models(
        matches,
        rng=np.random.default_rng(0),
        threshold_rad=_THRESHOLD_RAD,
        has_scale=len(second.cameras) > 1,
        relative=relative,
    )


def _most_agree(alignment: Alignment, relative: dict[tuple[int, int], Rigid3]) -> bool:
    """Return whether most pairs between two models have the rotation of their alignment."""
    turn = alignment.first_from_second.rotation.T
    agreeing = [float(geodesic_angle(pose.rotation, turn)) < _SAME_TURN_RAD for pose in relative.values()]
    return sum(agreeing) > len(agreeing) / 2
