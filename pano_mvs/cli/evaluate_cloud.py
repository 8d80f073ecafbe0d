"""Compare a cloud with true range maps or with a reference cloud."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from pano_mvs.algorithms.metrics.cloud import CloudDistances, CloudScore, cloud_distances, score_cloud
from pano_mvs.algorithms.metrics.poses import align_centers
from pano_mvs.algorithms.metrics.surface import TrueSurface, TrueView, surface_of_cloud, surface_of_views, view_points
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.cloud_picture import write_cloud_picture
from pano_mvs.io.names import match_image_names
from pano_mvs.io.ply_points import read_ply_points
from pano_mvs.io.pose_files import read_poses
from pano_mvs.io.truth import read_truth

_CLOUD, _MODEL = "cloud.ply", "colmap/sparse/0"


@dataclass(frozen=True, eq=False)
class _CloudTruth:
    """What a cloud is compared with: the whole surface in pieces, the part to be found, and the views that show it."""

    pieces: Sequence[NDArray[np.float32]]
    surface: TrueSurface
    used: dict[str, TrueView]
    views: int
    unit: str


def evaluate_cloud(
    cloud: Path,
    truth: Path,
    console: Console,
    *,
    poses: Path | None,
    true_poses: Path | None,
    thresholds: Sequence[float],
    picture: Path | None,
    as_json: bool,
) -> None:
    """Print accuracy, completeness and F-score of a cloud.

    Args:
        cloud: a PLY file, or the output folder of a run.
        truth: a folder with poses.json and depth.npz, or a reference cloud as a PLY file.
        console: where to print.
        poses: the poses with which the cloud was made, of the cameras that were used, in any form that `read_poses`
            reads; None: those in the output folder, or, beside a PLY file, a cloud in the truth's own frame from all
            of the truth's cameras.
        true_poses: those of a reference cloud's frame; None: the truth folder's.
        thresholds: tolerances in the truth's unit.
        picture: where to write a PNG that shows the errors; None: nowhere.
        as_json: print one JSON object and nothing else.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if a tolerance is not positive, or the poses do not determine how the frames lie.
    """
    if not thresholds or not min(thresholds) > 0:
        raise UsageError(f"tolerances must be positive, got {', '.join(map(str, thresholds)) or 'none'}")
    points = read_ply_points(cloud / _CLOUD if cloud.is_dir() else cloud)
    model = cloud / _MODEL if cloud.is_dir() and poses is None else poses
    known = _true_poses(truth, true_poses)
    used = list(known)
    if model is not None:
        if not known:
            raise InputError(f"{truth}: a reference cloud knows no cameras: give --true-poses to bring the cloud of "
                             f"{model} into its frame")  # fmt: skip
        truth_from_cloud, used = _alignment(model, known)
        points = truth_from_cloud.apply(points).astype(np.float32)
    compared = _cloud_truth(truth, used, min(thresholds))
    distances = cloud_distances(points, compared.pieces, compared.surface, limit=2 * max(thresholds))
    scores = score_cloud(distances, compared.surface, thresholds)
    if picture is not None:
        _write_picture(picture, points, distances, compared, thresholds)
    if as_json:
        print(json.dumps(_as_json(cloud, truth, points, compared, scores), indent=1, ensure_ascii=False))
    else:
        _print(points, compared, scores, console)


def _true_poses(truth: Path, true_poses: Path | None) -> dict[str, Rigid3]:
    if true_poses is not None:
        poses = read_poses(true_poses)
        return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    return read_truth(truth).poses if truth.is_dir() else {}


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


def _cloud_truth(truth: Path, used: list[str], voxel_size: float) -> _CloudTruth:
    if not truth.is_dir():
        reference = read_ply_points(truth)
        surface = surface_of_cloud(reference, voxel_size=voxel_size)
        return _CloudTruth([reference], surface, {}, 0, "units of the truth")
    known = read_truth(truth)
    views = {
        name: TrueView(view.cam_from_world, ranges)
        for name, view in known.views.items()
        if (ranges := known.range_map(view)) is not None
    }
    chosen = {name: views[name] for name in used if name in views}
    if not chosen:
        raise InputError(f"{truth}: holds no range map of a camera that was used ({', '.join(used[:3]) or 'none'})")
    pieces = [view_points(view) for view in views.values()]
    unit = "m" if known.metric else "units of the truth"
    return _CloudTruth(pieces, surface_of_views(list(chosen.values())), chosen, len(views), unit)


def _write_picture(
    path: Path,
    points: NDArray[np.float32],
    distances: CloudDistances,
    compared: _CloudTruth,
    thresholds: Sequence[float],
) -> None:
    """Draw what was found of the surface in each view that was used, and the cloud from above."""
    surface = compared.surface
    maps = {}
    for idx, (name, view) in enumerate(compared.used.items()):
        panorama = np.full(view.range.shape, np.nan, np.float32)
        own = surface.view_idx == idx
        panorama.reshape(-1)[surface.pixel_idx[own]] = distances.of_surface[own]
        maps[name] = panorama
    write_cloud_picture(path, maps, points, distances.of_points, limits=sorted(thresholds))


def _as_json(
    cloud: Path, truth: Path, points: NDArray[np.float32], compared: _CloudTruth, scores: Sequence[CloudScore]
) -> dict[str, object]:
    return {
        "cloud": str(cloud),
        "truth": str(truth),
        "unit": compared.unit,
        "points": len(points),
        "cameras": list(compared.used),
        "views_with_truth": compared.views,
        "scores": [score.as_dict() for score in scores],
    }


def _print(points: NDArray[np.float32], compared: _CloudTruth, scores: Sequence[CloudScore], console: Console) -> None:
    against = (f"the surface that {compared.views} views see; of it to be found is what at least 2 of "
               f"{len(compared.used)} cameras see") if compared.used else "a reference cloud"  # fmt: skip
    console.print(f"{len(points)} points against {against}", highlight=False, markup=False)
    table = Table(f"within, {compared.unit}", "accuracy %", "completeness %", "F-score %")
    for score in scores:
        shares = (score.accuracy, score.completeness, score.f_score)
        table.add_row(f"{score.threshold:g}", *(f"{100 * share:.2f}" for share in shares))
    console.print(table)
