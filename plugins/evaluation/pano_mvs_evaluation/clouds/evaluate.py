"""Comparison of a cloud with true range maps or with a reference cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.core.text import finite_or_none, plural
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.geometry.pose_errors import align_centers
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.ply import open_ply_points
from pano_mvs.io.truth import (
    Cameras,
    as_path,
    camera_groups,
    find_true_ranges,
    length_unit,
    read_cameras,
    source_name,
)
from pano_mvs.scene import PointCloud
from pano_mvs.scene.upright import WORLD_UP, mean_up_direction
from pano_mvs_evaluation.clouds.distances import (
    DEFAULT_THRESHOLDS,
    CloudDistances,
    CloudScore,
    MovedPoints,
    Points,
    PointsInMemory,
    PointSource,
    cloud_distances,
    score_cloud,
)
from pano_mvs_evaluation.clouds.true_surface import (
    TrueSurface,
    TrueView,
    surface_of_cloud,
    surface_of_views,
    view_points,
)
from pano_mvs_evaluation.tables import Summary, TextTable

CLOUD_FILE, MODEL_FOLDER = "cloud.ply", "colmap/sparse/0"

CloudInput = Path | PointCloud | NDArray[np.floating]
"""A PLY file or the output folder of a run, a record, or points (N, 3)."""


@dataclass(frozen=True, eq=False)
class CloudTruth:
    """What a cloud is compared with."""

    # returns the whole true surface at each call, in pieces (K, 3) of which one is in memory at a time
    pieces: Callable[[], Iterable[Points]]
    surface: TrueSurface  # the part that should be covered
    used: dict[str, TrueView]  # the views that show it, by name; none of a reference cloud
    views: int  # number of views with truth
    unit: str  # unit of lengths, for display
    cameras: NDArray[np.float64]  # (M, 3) centres of the cameras that were used, in the truth's world
    up: NDArray[np.float64]  # (3,) unit vector away from the ground, as far as the cameras agree


@dataclass(frozen=True, eq=False)
class CloudEvaluation:
    """Scores of a cloud, and its distances from the truth."""

    source: str  # name of the cloud's source
    truth: str  # name of the truth's source
    scores: tuple[CloudScore, ...]  # accuracy, completeness and F-score at each tolerance
    cloud: PointSource  # the points, in the truth's frame
    is_aligned: bool  # whether poses brought the cloud into the truth's frame; otherwise it was taken to lie in it
    compared: CloudTruth
    distances: CloudDistances  # from cloud to truth and back, measured up to `farthest`
    limits: tuple[float, ...]  # the tolerances in rising order
    farthest: float  # in the truth's unit

    def __repr__(self) -> str:
        """Return the main figures in a line."""
        scores = (f"{score.f_score:.3f} within {score.threshold:g} {self.compared.unit}" for score in self.scores)
        return f"CloudEvaluation({self.cloud.count} points, F-score {', '.join(scores)})"

    def to_json(self) -> dict[str, object]:
        """Return all figures as JSON values; None stands for a distance beyond those measured."""
        quantiles = self.distances.quantiles(self.compared.surface)
        return {
            "cloud": self.source,
            "truth": self.truth,
            "unit": self.compared.unit,
            "points": self.cloud.count,
            "cameras": list(self.compared.used),
            "views_with_truth": self.compared.views,
            "scores": [score.as_dict() for score in self.scores],
            "distances": {
                **{name: {"median": finite_or_none(m), "p90": finite_or_none(p)} for name, (m, p) in quantiles.items()},
                "told_up_to": self.farthest,
            },
        }

    def summary(self) -> Summary:
        """Return the main figures as text."""
        compared, unit = self.compared, self.compared.unit
        against = "a reference cloud"
        if compared.used:
            see = f"{compared.views} {plural(compared.views, 'view sees', 'views see')}"
            against = (
                f"the surface that {see}; of it to be found is what at least 2 of {len(compared.used)} cameras see"
            )
        lines: list[str | TextTable] = [f"{self.cloud.count} {plural(self.cloud.count, 'point')} against {against}"]
        if not compared.used and not self.is_aligned:
            lines.append(
                "both clouds are assumed to be in the same frame; otherwise, give the true poses in the frame of "
                "the reference cloud"
            )
        rows = tuple(
            (f"{score.threshold:g}", *(f"{100 * x:.2f}" for x in (score.accuracy, score.completeness, score.f_score)))
            for score in self.scores
        )
        lines.append(TextTable((f"within, {unit}", "accuracy %", "completeness %", "F-score %"), rows))
        quantiles = self.distances.quantiles(compared.surface)
        for label, name in (("points from the surface", "accuracy"), ("surface from the points", "completeness")):
            median, p90 = (f"{x:.4g}" if np.isfinite(x) else f"over {self.farthest:g}" for x in quantiles[name])
            lines.append(f"{label}: median {median}, 90 % within {p90} {unit}")
        return tuple(lines)


def evaluate_cloud(
    cloud: CloudInput | str,
    truth: CloudInput | str,
    *,
    poses: Cameras | str | None = None,
    true_poses: Cameras | str | None = None,
    thresholds: Sequence[float] = DEFAULT_THRESHOLDS,
) -> CloudEvaluation:
    """Compare a cloud with the true surface: accuracy, completeness and F-score.

    Args:
        cloud: a PLY file, the output folder of a run, a `PointCloud`, or points (N, 3).
        truth: a folder with poses and range maps, or a reference cloud in one of the forms of `cloud`.
        poses: the poses of the cameras with which the cloud was made. None: those in the output folder; otherwise
            the cloud lies in the truth's frame, and was made from all of the truth's cameras.
        true_poses: the true poses in the frame of a reference cloud. None: those in the truth's folder; without
            `poses`, the cloud lies in the reference cloud's frame.
        thresholds: tolerances in the truth's unit.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if a tolerance is not positive, or the poses do not determine the transform between the frames.

    Example:
        >>> import numpy as np
        >>> grid = np.stack(np.meshgrid([0.0, 1, 2], [0.0, 1, 2], [0.0]), axis=-1).reshape(-1, 3)
        >>> evaluation = evaluate_cloud(grid[:6] + 0.01, grid, thresholds=(0.1,))
        >>> score = evaluation.scores[0]
        >>> score.accuracy, round(score.completeness, 4)
        (1.0, 0.6667)
    """
    source: CloudInput = as_path(cloud)
    target: CloudInput = as_path(truth)
    given: Cameras | None = as_path(poses)
    limits = tuple(sorted(thresholds))
    if not limits or not limits[0] > 0:
        raise UsageError(f"tolerances must be positive, got {', '.join(map(str, limits)) or 'none'}")
    points = _open(source)
    model = given
    if isinstance(source, Path) and is_folder(source) and given is None:
        model = source / MODEL_FOLDER
    known, is_metric = _true_cameras(target, as_path(true_poses))
    used = list(known)
    if model is not None and (known or given is not None):
        if not known:
            raise InputError(
                f"{source_name(target)}: a reference cloud has no cameras: give the true poses to bring the cloud of "
                f"{source_name(model)} into its frame"
            )
        truth_from_cloud, used = _alignment(model, known)
        points = MovedPoints(points, truth_from_cloud)
    compared = _compared(target, used, known, voxel_size=limits[0], unit=length_unit(metric=is_metric))
    farthest = 20.0 * limits[-1]  # for quantiles and files
    distances = cloud_distances(points, compared.pieces(), compared.surface, limit=farthest)
    return CloudEvaluation(
        source=source_name(source),
        truth=source_name(target),
        scores=score_cloud(distances, compared.surface, thresholds),
        cloud=points,
        is_aligned=isinstance(points, MovedPoints),
        compared=compared,
        distances=distances,
        limits=limits,
        farthest=farthest,
    )


def _open(cloud: CloudInput) -> PointSource:
    if isinstance(cloud, Path):
        return open_ply_points(cloud / CLOUD_FILE if is_folder(cloud) else cloud)
    if isinstance(cloud, PointCloud):
        return PointsInMemory(cloud.points_in_world, cloud.normals_in_world)
    points = np.asarray(cloud, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise UsageError(f"points must be finite and of shape (N, 3), got {points.shape}")
    return PointsInMemory(points)


def _true_cameras(truth: CloudInput, true_poses: Cameras | None) -> tuple[Mapping[str, Rigid3], bool]:
    """Return the true cameras, none of a reference cloud alone, and whether lengths are metres."""
    if true_poses is not None:
        return read_cameras(true_poses)
    if not isinstance(truth, Path) or not is_folder(truth):
        return {}, False
    beside = truth / "poses.json"  # belongs to the range maps, whatever other poses the folder holds
    return read_cameras(beside if is_file(beside) else truth)


def _alignment(model: Cameras, known: Mapping[str, Rigid3]) -> tuple[Similarity3, list[str]]:
    """Return truth from model by the camera centres, and the truth's names of the model's cameras."""
    estimated = camera_groups(model)[0]
    ours = pair_image_names(known, estimated)
    try:
        aligned = align_centers({true: estimated[name] for true, name in ours.items()}, known)
    except UsageError as error:
        where = "the cloud cannot be brought into the frame of the truth"
        raise UsageError(f"{source_name(model)}: {where}: {error}") from error
    return aligned, list(ours)


def _compared(
    truth: CloudInput, used: Sequence[str], known: Mapping[str, Rigid3], *, voxel_size: float, unit: str
) -> CloudTruth:
    """Return the true surface: of the views of a folder, or of a reference cloud."""
    cameras = np.array([known[name].center for name in used]).reshape(-1, 3)
    common_up = mean_up_direction([known[name].rotation for name in used])
    up = np.array(WORLD_UP) if common_up is None else common_up  # for the images of the errors
    if not isinstance(truth, Path) or not is_folder(truth):
        reference = _open(truth)
        # Only some points of a reference cloud must be covered; all of them count for the cloud's own accuracy.
        some, _ = reference.some(max(1, -(-reference.count // 4_000_000)))
        surface = surface_of_cloud(some, voxel_size=voxel_size)
        return CloudTruth(reference.chunks, surface, {}, 0, length_unit(metric=False), cameras, up)
    files = find_true_ranges(truth)
    names = pair_image_names(known, files)
    views = {name: TrueView(pose, files[names[name]].read()) for name, pose in known.items() if name in names}
    chosen = {name: views[name] for name in used if name in views}
    if not chosen:
        raise InputError(f"{truth}: contains no range map of a camera that was used ({', '.join(used[:3]) or 'none'})")
    surface = surface_of_views(list(chosen.values()))
    return CloudTruth(lambda: map(view_points, views.values()), surface, chosen, len(views), unit, cameras, up)
