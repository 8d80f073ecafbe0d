"""Check a range map against those of neighbouring views, and set its confidence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import confirmed_uncertainty, probability_within
from pano_mvs.algorithms.ranges.agreement import Comparison, compare_with_sources
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of a view's sources with its ranges, by solid angle.

    `compared`: share of the sphere with a range that at least one source can compare with its own. `agreed`: share of
    that with which at least one source agrees. `seen_through`: share of that with which no source agrees and behind
    which at least three quarters of the comparing sources, and at least two, see something farther away. `hidden`:
    likewise with something nearer, which occludes it.
    """

    compared: float
    agreed: float
    seen_through: float
    hidden: float

    @property
    def one_way(self) -> float:
        """The share that the sources contradict unanimously in one direction."""
        return self.seen_through + self.hidden


_LOOKS_RIGHT = 0.01
"""How often a right camera looks like one whose ranges other views contradict; none of those that were measured did."""


def evidence_of_views(
    agreements: Mapping[str, Agreement], centers: Mapping[str, NDArray[np.float64]]
) -> dict[str, tuple[float, str]]:
    """Return the views whose sources speak against their poses, with a likelihood ratio and what it rests on.

    The sources agree with a much smaller share of the ranges of such a view than is usual for the views around it, and
    contradict most of the rest in one direction. Matching errors scatter; a wrong pose moves everything.

    Args:
        agreements: view name to agreement.
        centers: (3,) camera centres of the views of one world frame; views without one are not judged.

    Returns:
        View name to the likelihood of this if its pose is right, relative to that if it is wrong, and a sentence. Views
        without anything against them are left out.
    """
    # If little can be compared, or neighbours agree with no view either, nothing can be concluded.
    names = [name for name in agreements if name in centers and agreements[name].compared >= 0.2]
    if len(names) < 3:
        return {}
    places = np.array([centers[name] for name in names])
    agreed = np.array([agreements[name].agreed for name in names])
    found = {}
    for idx, (name, around) in enumerate(zip(names, nearest_views(places), strict=True)):
        usual = float(np.median(agreed[around]))
        one_way = agreements[name].one_way
        # Relative to the agreement of its neighbours. Cameras with true poses had 0.64 or more (rendered and synthetic
        # rooms, including plain ones; 4 to 9 views, 2 to 8 sources), lowest at the edge of a capture; cameras half a
        # metre off had at most 0.47. Contradictions in one direction are not sufficient alone (cameras with true poses
        # had at most 0.62, cameras half a metre off 0.63 or more): they exclude views whose errors scatter.
        if usual >= 0.1 and agreed[idx] < 0.55 * usual and one_way >= 0.55:
            found[name] = (
                _LOOKS_RIGHT,
                f"other views agree with {100 * agreed[idx]:.0f} % of its ranges (usual around it: {100 * usual:.0f} "
                f"%) and contradict {100 * one_way:.0f} % in one direction",
            )
    return found


def nearest_views(places: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Yield for each view the indices of the four nearest other views, nearest first; ties in their order.

    `places`: (N, 3) camera centres, at least two.
    """
    from scipy.spatial import cKDTree

    count = min(4, len(places) - 1)
    tree = cKDTree(places)
    # The view itself is among the results, unless more than `count` others coincide with it.
    farthest = np.asarray(tree.query(places, k=count + 1)[0])[:, -1]
    for idx, place in enumerate(places):
        # Slightly more than the distance of the last one, so that rounding does not exclude ones at the same distance.
        within = np.array(sorted(tree.query_ball_point(place, farthest[idx] * (1 + 1e-9))), np.int64)
        within = within[within != idx]
        yield within[np.argsort(np.linalg.norm(places[within] - place, axis=1), kind="stable")[:count]]


# Of the sources that can compare a pixel, these must contradict it in one direction for it to count as contradicted.
_ONE_WAY = 0.75


def check_consistency(
    reference: RangeMap,
    reference_pose: Rigid3,
    sources: Sequence[RangeMap],
    *,
    source_poses: Sequence[Rigid3],
    **settings: Any,
) -> RangeMap:
    """Set the confidence of a range map by the sources that confirm it.

    See `checked_with_agreement`, which has the same settings and also returns the agreement of the sources with the
    view as a whole.
    """
    return checked_with_agreement(reference, reference_pose, sources, source_poses=source_poses, **settings)[0]


@checks_settings
def checked_with_agreement(
    reference: RangeMap,
    reference_pose: Rigid3,
    sources: Sequence[RangeMap],
    *,
    source_poses: Sequence[Rigid3],
    max_relative_error: Annotated[float, Setting("maximum relative difference of ranges that agree", gt=0)] = 0.02,
    max_reprojection_px: Annotated[float, Setting("maximum forward-backward reprojection error", gt=0)] = 1.0,
    max_reprojection_deg: Annotated[
        float, Setting("the same as an angle, which replaces a smaller max_reprojection_px", ge=0)
    ] = 0.35,
    min_support: Annotated[
        float, Setting("minimum sum over sources of (1 - (error / maximum)²)² for a pixel", ge=0)
    ] = 0.85,
    min_motion_px: Annotated[
        float, Setting("minimum motion of a pixel in the sources if its range changes by max_relative_error", ge=0)
    ] = 0.05,
    min_views: Annotated[int, Setting("minimum number of sources that confirm a pixel", ge=1)] = 1,
    remove_inconsistent: Annotated[
        bool, Setting("remove pixels that no source confirms and several contradict")
    ] = False,
    min_contradictions: Annotated[int, Setting("number of contradicting sources for removal", ge=1)] = 2,
) -> tuple[RangeMap, Agreement]:
    """Set the confidence of a range map by the sources that confirm it, and summarise their agreement.

    Forward and backward: the point at range r along a pixel's ray is projected into a source, X' = R r F(u) + t. The
    source's own range s there must equal |X'| within `max_relative_error`, and the source's point at s, seen from the
    reference, must lie within the maximum reprojection error of the pixel (Schönberger et al., "Pixelwise view
    selection for unstructured multi-view stereo", 2016, section 4.3, on the sphere). The source then agrees, and
    supports the pixel with (1 − (e / maximum)²)², where e is its reprojection error. If s is smaller, the point is
    occluded and the source is ignored. If s is larger by more than twice the limit, the source sees through the point
    and contradicts it. Filled ranges of sources are ignored, too.

    Close to the epipoles, sources agree on any range. So each source also measures how far a relative change of the
    range would move the point, m = sin γ r / |X'| radians, where γ is the angle between the two rays at the point. With
    the sum S of the supports and M² = Σ support · m², a pixel is consistent if `min_views` sources agree, S ≥
    `min_support`, and a change by `max_relative_error` moves it by at least `min_motion_px`: μ = M max_relative_error.

    Confidence of a pixel that was seen and is consistent: 128 + ⌊127 p⌋, where p is the probability that its range is
    right within `max_relative_error` (`probability_within` of its `confirmed_uncertainty`). Otherwise the pixel is weak
    and its confidence is clipped to 64–127; filled pixels keep theirs.

    Args:
        reference: (H, W) range map, full sphere; its normals are kept.
        reference_pose: its cam_from_world.
        sources: range maps, (H', W') each, in any order: the result does not depend on it.
        source_poses: cam_from_world of each.
        max_reprojection_deg: the same in degrees; the larger of the two counts. Poses, stitching and soft panoramas
            limit the accuracy of matches to an angle, so that a limit in pixels alone confirms less the more pixels
            there are. 0.35° is a pixel at 1024 columns.

    Returns:
        The checked range map with the uncertainty of its ranges (`confirmed_uncertainty`), and the agreement of the
        sources with the view as a whole.

    Raises:
        UsageError: if sources and poses differ in number, or a setting is out of bounds.
    """
    if len(sources) != len(source_poses):
        raise UsageError(f"{len(sources)} source range maps but {len(source_poses)} poses: give one pose per source")
    px_per_rad = reference.range.shape[1] / (2 * np.pi)
    consistent, comparison = consistent_pixels(
        reference,
        reference_pose,
        sources,
        source_poses=source_poses,
        max_relative_error=max_relative_error,
        max_angle_rad=max(max_reprojection_px / px_per_rad, np.radians(max_reprojection_deg)),
        min_support=min_support,
        min_motion_rad=min_motion_px / px_per_rad,
        min_views=min_views,
    )
    step = _step_around(reference.range)
    uncertainty = confirmed_uncertainty(consistent, reference.range, comparison, step=step)
    low, high = CONSISTENT_CONFIDENCE
    probability = probability_within(uncertainty.astype(np.float64), max_relative_error)
    graded = np.floor(low + (high - low) * probability).astype(np.uint8)
    weak = np.clip(reference.confidence, *WEAK_CONFIDENCE)
    seen = reference.confidence >= WEAK_CONFIDENCE[0]
    confidence = np.where(seen, np.where(consistent, graded, weak), reference.confidence)
    ranges = reference.range
    if remove_inconsistent and sources:
        removed = (comparison.agreeing == 0) & (comparison.contradicting >= min(min_contradictions, len(sources)))
        ranges = np.where(removed, np.float32(np.nan), ranges)
    confidence[np.isnan(ranges)] = 0
    uncertainty[np.isnan(ranges)] = np.nan
    return RangeMap(ranges, confidence, reference.normals_in_cam, uncertainty, reference.sky), _agreement(
        comparison, seen
    )


def consistent_pixels(
    reference: RangeMap,
    reference_pose: Rigid3,
    sources: Sequence[RangeMap],
    *,
    source_poses: Sequence[Rigid3],
    max_relative_error: float,
    max_angle_rad: float,
    min_support: float,
    min_motion_rad: float,
    min_views: int = 1,
) -> tuple[NDArray[np.bool_], Comparison]:
    """Return the pixels (H, W) that were seen and that the sources confirm, and how each pixel compares.

    The arguments are those of `checked_with_agreement`, with limits as angles.
    """
    comparison = compare_with_sources(
        reference.range,
        sources,
        [pose @ reference_pose.inverse() for pose in source_poses],
        max_relative_error=max_relative_error,
        max_angle=max_angle_rad,
    )
    moved = max_relative_error * np.sqrt(comparison.motion) >= min_motion_rad
    seen = (reference.confidence >= WEAK_CONFIDENCE[0]) & ~np.isnan(reference.range)
    return seen & moved & (comparison.agreeing >= min_views) & (comparison.support >= min_support), comparison


def _agreement(comparison: Comparison, seen: NDArray[np.bool_]) -> Agreement:
    """Return the agreement of the sources with all pixels that were seen, (H, W)."""
    judges = comparison.agreeing + comparison.contradicting + comparison.hiding
    row_weights = pixel_solid_angle(seen.shape) * seen.shape[1] / (4 * np.pi)

    def share(where: NDArray[np.bool_]) -> float:
        return float(np.sum(where.mean(axis=1) * row_weights))

    compared = seen & (judges > 0)
    contradicted = compared & (comparison.agreeing == 0) & (judges >= 2)
    total = share(compared)
    parts = (
        compared & (comparison.agreeing > 0),
        contradicted & (comparison.contradicting >= _ONE_WAY * judges),
        contradicted & (comparison.hiding >= _ONE_WAY * judges),
    )
    return Agreement(total, *(share(part) / total if total else 0.0 for part in parts))


def _step_around(ranges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ln(largest / smallest valid range) within two pixels, (H, W); 0 without valid pixels."""
    radius = 2
    logs = pad_panorama(np.log(ranges), radius)
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    nearest = cv2.erode(np.where(np.isnan(logs), np.float32(np.inf), logs), window)
    farthest = cv2.dilate(np.where(np.isnan(logs), np.float32(-np.inf), logs), window)
    step = np.where(farthest >= nearest, farthest, 0) - np.where(farthest >= nearest, nearest, 0)
    return np.asarray(step[radius:-radius, radius:-radius], np.float32)
