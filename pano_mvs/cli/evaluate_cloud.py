"""Compare a cloud with true range maps or with a reference cloud."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from pano_mvs.algorithms.metrics.cloud import (
    DEFAULT_THRESHOLDS,
    CloudDistances,
    CloudScore,
    PointChunks,
    cloud_distances,
    score_cloud,
)
from pano_mvs.algorithms.metrics.poses import align_centers
from pano_mvs.algorithms.metrics.surface import TrueSurface, TrueView, surface_of_cloud, surface_of_views, view_points
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.clouds.ply_points import PlyPoints, open_ply_points
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges.folders import match_pictures
from pano_mvs.io.truth import find_true_ranges

_CLOUD, _MODEL = "cloud.ply", "colmap/sparse/0"
# Distances are told apart up to this many times the largest tolerance; for quantiles and files, not for scores.
_FARTHEST = 20.0
# Of a reference cloud, as many points as may have to be found; all of them count for the cloud's own accuracy.
_MOST_SAMPLES = 4_000_000
# Length of the mean of the cameras' own vertical axes from which they are held to agree on where up is.
_AGREED = 0.5


@dataclass(frozen=True)
class CloudRequest:
    """What `evaluate cloud` is asked for.

    Attributes:
        cloud: a PLY file, or the output folder of a run.
        truth: a folder with poses in any form that `read_poses` reads and range maps in any that `find_true_ranges`
            finds, or a reference cloud as a PLY file.
        poses: the poses with which the cloud was made, of the cameras that were used, in any form that `read_poses`
            reads; None: those in the output folder, or, beside a PLY file, a cloud in the truth's own frame from all
            of the truth's cameras.
        true_poses: those of a reference cloud's frame; None: the truth folder's, or, without `poses`, a cloud in the
            reference cloud's own frame.
        thresholds: tolerances in the truth's unit.
    """

    cloud: Path
    truth: Path
    poses: Path | None = None
    true_poses: Path | None = None
    thresholds: tuple[float, ...] = DEFAULT_THRESHOLDS


@dataclass(frozen=True, eq=False)
class CloudTruth:
    """What a cloud is compared with.

    Attributes:
        pieces: begins anew to give the whole true surface, one piece (K, 3) in memory at a time.
        surface: the part to be found.
        used: the views that show it, by name; none of a reference cloud.
        views: number of views with truth.
        unit: of lengths.
        cameras: (M, 3) where the cameras that were used stood, in the truth's world.
        up: (3,) unit vector away from the ground, as far as the cameras tell.
    """

    pieces: Callable[[], Iterable[NDArray[np.float32]]]
    surface: TrueSurface
    used: dict[str, TrueView]
    views: int
    unit: str
    cameras: NDArray[np.float64]
    up: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JudgedCloud:
    """A cloud and its distances from the truth.

    Attributes:
        file: the cloud's vertices, in its own frame.
        truth_from_cloud: what brings it into the truth's; None: it is there.
        compared: with what.
        distances: from the truth and back, told apart up to `farthest`.
        thresholds: tolerances in rising order.
        farthest: in the truth's unit.
    """

    file: PlyPoints
    truth_from_cloud: Similarity3 | None
    compared: CloudTruth
    distances: CloudDistances
    thresholds: tuple[float, ...]
    farthest: float

    def points(self) -> Iterator[NDArray[np.float32]]:
        """Return the cloud's points in chunks (K, 3), in the truth's frame."""
        return _in_truth(self.file, self.truth_from_cloud)


def evaluate_cloud(
    request: CloudRequest, console: Console, *, out: Path | None = None, picture: Path | None = None, as_json: bool
) -> None:
    """Print accuracy, completeness and F-score of a cloud.

    Args:
        request: what is compared.
        console: where to print.
        out: folder for the clouds coloured by their errors, and for pictures of them; None: nowhere.
        picture: where to write a PNG that shows the errors in the views and from above; None: nowhere.
        as_json: print one JSON object and nothing else.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if a tolerance is not positive, or the poses do not determine how the frames lie.
    """
    judged = judge_cloud(request)
    scores = score_cloud(judged.distances, judged.compared.surface, request.thresholds)
    if picture is not None or out is not None:
        # The modules that draw are needed here alone.
        from pano_mvs.cli.evaluate_cloud_pictures import write_error_clouds, write_overview

        if picture is not None:
            write_overview(picture, judged)
        if out is not None:
            write_error_clouds(out, judged)
    if as_json:
        print(json.dumps(_as_json(request, judged, scores), indent=1, ensure_ascii=False, allow_nan=False))
        return
    _print(judged, scores, console)
    if out is not None:
        console.print(f"accuracy.ply, completeness.ply and pictures of the errors are in {out}", highlight=False,
                      markup=False, soft_wrap=True)  # fmt: skip


def judge_cloud(request: CloudRequest) -> JudgedCloud:
    """Return how far a cloud is from the truth.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if a tolerance is not positive, or the poses do not determine how the frames lie.
    """
    thresholds = tuple(sorted(request.thresholds))
    if not thresholds or not thresholds[0] > 0:
        raise UsageError(f"tolerances must be positive, got {', '.join(map(str, thresholds)) or 'none'}")
    cloud, truth = request.cloud, request.truth
    file = open_ply_points(cloud / _CLOUD if is_folder(cloud) else cloud)
    model = cloud / _MODEL if is_folder(cloud) and request.poses is None else request.poses
    known, is_metric = _true_poses(truth, request.true_poses)
    used, truth_from_cloud = list(known), None
    if model is not None and (known or request.poses is not None):
        if not known:
            raise InputError(f"{truth}: a reference cloud knows no cameras: give --true-poses to bring the cloud of "
                             f"{model} into its frame")  # fmt: skip
        truth_from_cloud, used = _alignment(model, known)
    compared = _cloud_truth(truth, used, thresholds[0], known, is_metric=is_metric)
    farthest = _FARTHEST * thresholds[-1]
    points = PointChunks(file.count, lambda: _in_truth(file, truth_from_cloud))
    distances = cloud_distances(points, compared.pieces(), compared.surface, limit=farthest)
    return JudgedCloud(file, truth_from_cloud, compared, distances, thresholds, farthest)


def _in_truth(file: PlyPoints, truth_from_cloud: Similarity3 | None) -> Iterator[NDArray[np.float32]]:
    for chunk in file.chunks():
        yield chunk if truth_from_cloud is None else truth_from_cloud.apply(chunk).astype(np.float32)


def _true_poses(truth: Path, true_poses: Path | None) -> tuple[dict[str, Rigid3], bool]:
    """Return the true cameras, none of a reference cloud alone, and whether lengths are metres."""
    if true_poses is None and not is_folder(truth):
        return {}, False
    beside = truth / "poses.json"  # of the ranges, whatever other poses lie there
    poses = read_poses(true_poses or (beside if is_file(beside) else truth))
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}, poses.metric


def _alignment(model: Path, known: dict[str, Rigid3]) -> tuple[Similarity3, list[str]]:
    """Return truth from model by the camera centres alone, and the truth's names of the model's cameras."""
    poses = read_poses(model)
    estimated = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    ours = match_image_names(known, estimated)
    try:
        aligned = align_centers({true: estimated[name] for true, name in ours.items()}, known)
    except UsageError as error:
        raise UsageError(f"{model}: the cloud cannot be brought into the frame of the truth: {error}") from error
    return aligned, list(ours)


def _cloud_truth(
    truth: Path, used: list[str], voxel_size: float, known: dict[str, Rigid3], *, is_metric: bool
) -> CloudTruth:
    cameras = np.array([known[name].center for name in used if name in known]).reshape(-1, 3)
    up = _up([known[name] for name in used if name in known])
    if not is_folder(truth):
        reference = open_ply_points(truth)
        some, _ = reference.some(max(1, -(-reference.count // _MOST_SAMPLES)))
        surface = surface_of_cloud(some, voxel_size=voxel_size)
        return CloudTruth(reference.chunks, surface, {}, 0, "units of the truth", cameras, up)
    files = find_true_ranges(truth)
    names = match_pictures(known, files)
    views = {name: TrueView(pose, files[names[name]].read()) for name, pose in known.items() if name in names}
    chosen = {name: views[name] for name in used if name in views}
    if not chosen:
        raise InputError(f"{truth}: holds no range map of a camera that was used ({', '.join(used[:3]) or 'none'})")
    unit = "m" if is_metric else "units of the truth"
    surface = surface_of_views(list(chosen.values()))
    return CloudTruth(lambda: map(view_points, views.values()), surface, chosen, len(views), unit, cameras, up)


def _up(cameras: Sequence[Rigid3]) -> NDArray[np.float64]:
    """Return the unit vector (3,) that is up for most cameras, for pictures; that of the world where they disagree."""
    down = np.mean([camera.rotation[1] for camera in cameras], axis=0) if cameras else np.zeros(3)
    length = float(np.linalg.norm(down))
    return -down / length if length > _AGREED else np.array([0.0, -1.0, 0.0])


def _as_json(request: CloudRequest, judged: JudgedCloud, scores: Sequence[CloudScore]) -> dict[str, object]:
    compared = judged.compared
    told = {
        name: {"median": _finite(median), "p90": _finite(p90)}
        for name, (median, p90) in judged.distances.quantiles(compared.surface).items()
    }
    return {
        "cloud": str(request.cloud),
        "truth": str(request.truth),
        "unit": compared.unit,
        "points": judged.file.count,
        "cameras": list(compared.used),
        "views_with_truth": compared.views,
        "scores": [score.as_dict() for score in scores],
        "distances": told | {"told_up_to": judged.farthest},
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _print(judged: JudgedCloud, scores: Sequence[CloudScore], console: Console) -> None:
    compared = judged.compared
    see = plural(compared.views, "view sees", "views see")
    against = (f"the surface that {compared.views} {see}; of it to be found is what at least 2 of "
               f"{len(compared.used)} cameras see") if compared.used else "a reference cloud"  # fmt: skip
    console.print(
        f"{judged.file.count} {plural(judged.file.count, 'point')} against {against}", highlight=False, markup=False
    )
    if not compared.used and judged.truth_from_cloud is None:
        console.print("both clouds are taken to lie in one frame; if they do not, give --true-poses, those in the "
                      "frame of the reference cloud", highlight=False, markup=False, soft_wrap=True)  # fmt: skip
    table = Table(f"within, {compared.unit}", "accuracy %", "completeness %", "F-score %")
    for score in scores:
        shares = (score.accuracy, score.completeness, score.f_score)
        table.add_row(f"{score.threshold:g}", *(f"{100 * share:.2f}" for share in shares))
    console.print(table)
    found = judged.distances.quantiles(compared.surface)
    for label, name in (("points from the surface", "accuracy"), ("surface from the points", "completeness")):
        median, p90 = (f"{value:.4g}" if np.isfinite(value) else f"over {judged.farthest:g}" for value in found[name])
        text = f"{label}: median {median}, 90 % within {p90} {compared.unit}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)
