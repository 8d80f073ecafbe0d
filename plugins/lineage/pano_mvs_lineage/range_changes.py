"""How the range maps of two runs differ, by what their confidence says."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import Poses
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE
from pano_mvs_lineage.alignment import align_runs
from pano_mvs_lineage.stored_runs import StoredRun

LIMIT = 0.01  # a range that differs by more than this share counts as changed
CLASSES = {"confirmed": CONSISTENT_CONFIDENCE, "seen": WEAK_CONFIDENCE, "filled": FILLED_CONFIDENCE}


@dataclass(frozen=True)
class RangeChange:
    """How the range map of one view differs; all shares are of solid angle."""

    name: str
    changed: float  # share of what both runs have that differs by more than 1 %
    median: float  # median of the relative difference; NaN if no pixel has a range in both
    only_before: float  # share of the sphere that has a range only there
    only_after: float
    # class of the later run (confirmed, seen, filled) to the changed share of it; classes without pixels are left out
    by_class: dict[str, float]
    size_differs: bool = False  # whether the maps have different sizes, and the later one was resized

    def __str__(self) -> str:
        classes = ", ".join(f"{name} {share:.1%}" for name, share in self.by_class.items())
        gone = f", only before {self.only_before:.1%}" if self.only_before >= 0.0005 else ""
        more = f", only after {self.only_after:.1%}" if self.only_after >= 0.0005 else ""
        return f"{self.name}: {self.changed:.1%} differ by more than 1 % ({classes}){gone}{more}"


def range_changes(old: StoredRun, new: StoredRun) -> tuple[RangeChange, ...]:
    """Return how the range maps of the views that both runs have differ; views that are equal are left out.

    Ranges of runs in other units of length are compared after scaling by the distances of the cameras.
    """
    found = []
    common = [name for name in old.output.views if name in new.output.views]
    for name, scale in scales_of_views(common, old, new).items():
        before, after = (run.output.views[name] for run in (old, new))
        one, other, confidence = before.range_map, after.range_map, after.confidence
        if one is None or other is None:
            continue
        change = compare_ranges(name, scale * one, other, confidence=confidence)
        if change.changed or change.only_before or change.only_after or change.median > 1e-6:
            found.append(change)
    return tuple(found)


def relative_difference(before: NDArray[np.float32], after: NDArray[np.float32]) -> FloatArray:
    """Return |before / after − 1| (H, W) at the size of `before`, NaN where one has no range."""
    height, width = before.shape
    if after.shape != before.shape:
        after = cv2.resize(after, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.abs(before.astype(np.float64) / after - 1)


def compare_ranges(
    name: str,
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    *,
    confidence: NDArray[np.uint8] | None = None,
) -> RangeChange:
    """Return how two range maps (H, W) of one view differ.

    Args:
        confidence: (H, W) uint8, of the later one; None if it is not known.
    """
    size_differs = before.shape != after.shape
    difference = relative_difference(before, after)
    height, width = before.shape
    weight = np.broadcast_to(pixel_solid_angle((height, width)).reshape(height, -1), (height, width))
    if size_differs:
        after = cv2.resize(after, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.float32)
        if confidence is not None:
            confidence = cv2.resize(confidence, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.uint8)
    has, had = np.isfinite(after), np.isfinite(before)
    both = has & had
    wrong = both & (difference > LIMIT)
    by_class = {}
    if confidence is not None:
        for what, (least, most) in CLASSES.items():
            here = both & (confidence >= least) & (confidence <= most)
            if here.any():
                by_class[what] = _share(wrong & here, here, weight)
    return RangeChange(
        name=name,
        changed=_share(wrong, both, weight),
        median=float(np.median(difference[both])) if both.any() else float("nan"),
        only_before=_share(had & ~has, np.ones_like(both), weight),
        only_after=_share(has & ~had, np.ones_like(both), weight),
        by_class=by_class,
        size_differs=size_differs,
    )


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_], weight: FloatArray) -> float:
    total = float(weight[whole].sum())
    return float(weight[part].sum()) / total if total else 0.0


def scales_of_views(names: Iterable[str], old: StoredRun, new: StoredRun) -> dict[str, float]:
    """Return the factor from the unit of length of each view in one run to that in the other; 1 if it is not known.

    Each group of cameras has a unit of its own: those of the view's groups that both runs have are compared.
    """
    one, other = old.output.poses, new.output.poses
    if one is None or other is None:
        return dict.fromkeys(names, 1.0)
    groups = [dict(zip(poses.names, poses.groups.tolist(), strict=True)) for poses in (one, other)]
    members: dict[tuple[int, int], list[str]] = {}
    for image in one.names:
        if image in groups[1]:
            members.setdefault((groups[0][image], groups[1][image]), []).append(image)
    scales = {image: scale for common in members.values() for image, scale in _scales(common, one, other)}
    return {name: scales.get(name, 1.0) for name in names}


def _scales(images: Sequence[str], one: Poses, other: Poses) -> Iterator[tuple[str, float]]:
    """Yield images of one group with the factor between their units of length."""
    try:
        scale = align_runs(*({image: poses.cameras[image] for image in images} for poses in (one, other))).scale
    except UsageError:  # too few cameras, or all in one place
        scale = 1.0
    yield from ((image, 1.0 if abs(scale - 1) < 1e-9 else scale) for image in images)
