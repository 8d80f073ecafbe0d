"""Comparison of poses from any source with true poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.text import finite_or_none, plural, shortened_list
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import CenterErrors, PoseErrors, center_errors, relative_pose_errors
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.truth import Cameras, as_path, camera_groups, length_unit, read_cameras, source_name
from pano_mvs_evaluation.tables import Summary, TextTable


@dataclass(frozen=True, eq=False)
class PoseEvaluation:
    """Errors of poses against the truth; image names are those of the truth."""

    model: str  # name of the estimates' source
    truth: str  # name of the truth's source
    unit: str  # unit of lengths, for display
    pairs: PoseErrors  # errors over all pairs of the truth's images; a pair with an unregistered image is 180° off
    registered_pairs: PoseErrors  # errors over the pairs of registered images
    # errors of the camera centres after similarity alignment, or None if no alignment is possible
    centers: CenterErrors | None
    no_centers: str = ""  # why there is no alignment; otherwise ""
    without_truth: tuple[str, ...] = ()  # registered images without truth, by their own names
    # number of images in each further group of the model, which count as not registered
    other_groups: tuple[int, ...] = ()

    def __repr__(self) -> str:
        """Return the main figures in a line."""
        images = f"{self.pairs.registered} of {self.pairs.expected} images"
        return f"PoseEvaluation({images} registered, median error of a pair {self.pairs.median_pair_deg:.3g}°)"

    def to_json(self) -> dict[str, object]:
        """Return all figures as JSON values; None stands for what cannot be determined."""
        some, all_pairs = self.registered_pairs, self.pairs
        return {
            "registered": all_pairs.registered,
            "of": all_pairs.expected,
            "pairs": len(all_pairs.pairs),
            "rotation_deg": _statistics(some.rotation_deg),
            "direction_deg": _statistics(some.direction_deg),
            "pair_deg": _statistics(some.pair_deg),
            "pair_deg_all": _statistics(all_pairs.pair_deg),
            "auc": {f"{limit:g}": value for limit, value in all_pairs.auc.items()},
            "scale_ratio_error": {
                "median": finite_or_none(some.scale_ratio_median),
                "max": finite_or_none(some.scale_ratio_max),
            },
            "center": self._centers_json(),
            "model": self.model,
            "truth": self.truth,
            "unit": self.unit,
            "without_truth": list(self.without_truth),
        }

    def _centers_json(self) -> dict[str, object]:
        if self.centers is None:
            return {"reason": self.no_centers}
        lengths, extent = self.centers.distances, self.centers.extent
        return {
            **_statistics(lengths),
            "rms": float(np.sqrt(np.mean(lengths**2))),
            "extent": extent,
            "median_share_of_extent": float(np.median(lengths)) / extent,
            "max_share_of_extent": float(lengths.max()) / extent,
            "scale": self.centers.scale,
            "images": dict(zip(self.centers.names, lengths.tolist(), strict=True)),
        }

    def summary(self) -> Summary:
        """Return the main figures as text."""
        pairs, some, centers = self.pairs, self.registered_pairs, self.centers
        rows = [
            _row("rotation °", some.rotation_deg, ".4f"),
            _row("translation direction °", some.direction_deg, ".4f"),
            _row("pair (the larger) °", some.pair_deg, ".4f"),
        ]
        if centers is not None:
            rows.append(_row(f"camera centre, {self.unit}", centers.distances, ".5g"))
            rows.append(_row("camera centre, % of extent", 100 * centers.distances / centers.extent, ".4f"))
        auc = ", ".join(f"{100 * value:.1f} @ {limit:g}°" for limit, value in pairs.auc.items())
        lines = [f"AUC over {plural(len(pairs.pairs), 'one pair', f'all {len(pairs.pairs)} pairs')}, %: {auc}"]
        if np.isfinite(some.scale_ratio_max):
            lines.append(
                f"translation scale ratios: median {100 * some.scale_ratio_median:.3f} %, largest "
                f"{100 * some.scale_ratio_max:.3f} % off"
            )
        if centers is not None:
            scale = f"one unit of the model is {centers.scale:.6g} {self.unit}"
            lines.append(f"extent {centers.extent:.5g} {self.unit}; {scale}")
        else:
            lines.append(f"camera centres are not compared: {self.no_centers}")
        if self.other_groups:
            lines.append(
                f"{len(self.other_groups)} further {plural(len(self.other_groups), 'group')} of "
                f"{sum(self.other_groups)} {plural(sum(self.other_groups), 'image')} in {self.model}, each "
                "with a frame of its own, count as not registered"
            )
        if self.without_truth:
            lines.append(f"no ground truth for {shortened_list(self.without_truth)}")
        over = f"over {len(some.pairs)} {plural(len(some.pairs), 'pair')} of registered images"
        registered = f"{pairs.registered} of {pairs.expected} {plural(pairs.expected, 'image')} registered"
        return (registered, TextTable((over, "median", "mean", "max"), tuple(rows)), *lines)


def evaluate_poses(model: Cameras | str, truth: Cameras | str) -> PoseEvaluation:
    """Compare poses with the truth, whatever their world frames and units.

    Args:
        model: estimated poses: a file or folder that `read_poses` reads, `Poses`, or cam_from_world by image name. Of
            several groups of cameras the largest is compared.
        truth: the true poses, in any of these forms. Images are paired by name (see `pair_image_names`).

    Raises:
        InputError: if a file cannot be read, or the two have fewer than two images in common.

    Example:
        >>> import numpy as np
        >>> from pano_mvs.geometry import Rigid3
        >>> truth = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", 0.0), ("b", 2.0))}
        >>> moved = {f"{name}.jpg": Rigid3(pose.rotation, 3 * pose.translation) for name, pose in truth.items()}
        >>> evaluation = evaluate_poses(moved, truth)
        >>> evaluation.pairs.registered, evaluation.pairs.median_pair_deg
        (2, 0.0)
    """
    source: Cameras = as_path(model)
    target: Cameras = as_path(truth)
    estimated, *others = camera_groups(source)
    known, metric = read_cameras(target)
    ours = {name: match for match, name in pair_image_names(estimated, known).items()}
    if len(ours) < 2:
        raise InputError(
            f"{source_name(source)} and {source_name(target)} have {len(ours) or 'no'} {plural(len(ours), 'image')} in "
            f"common, two are needed to compare poses. The model has {shortened_list(estimated)}, the truth "
            f"{shortened_list(known)}"
        )
    found: dict[str, Rigid3] = {name: estimated[ours[name]] for name in known if name in ours}
    centers, reason = _centers(found, known)
    return PoseEvaluation(
        model=source_name(source),
        truth=source_name(target),
        unit=length_unit(metric=metric),
        pairs=relative_pose_errors(found, known),
        registered_pairs=relative_pose_errors(found, {name: known[name] for name in found}),
        centers=centers,
        no_centers=reason,
        without_truth=tuple(name for name in estimated if name not in set(ours.values())),
        other_groups=tuple(len(group) for group in others),
    )


def _centers(found: Mapping[str, Rigid3], known: Mapping[str, Rigid3]) -> tuple[CenterErrors | None, str]:
    try:
        return center_errors(found, known), ""
    except UsageError as error:
        return None, str(error)


def _statistics(values: NDArray[np.float64]) -> dict[str, float]:
    return {"median": float(np.median(values)), "mean": float(values.mean()), "max": float(values.max())}


def _row(label: str, values: NDArray[np.float64], form: str) -> tuple[str, ...]:
    return (label, *(format(value, form) for value in _statistics(values).values()))
