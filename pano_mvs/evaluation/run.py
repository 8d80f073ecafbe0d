"""Comparison of the output folder of a run with ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.evaluation.capture import score_capture
from pano_mvs.evaluation.clouds.evaluate import CLOUD_FILE, MODEL_FOLDER, CloudEvaluation, evaluate_cloud
from pano_mvs.evaluation.inputs import camera_groups, find_ranges, find_true_ranges, read_cameras
from pano_mvs.evaluation.ranges.evaluate import DepthEvaluation, evaluate_depth
from pano_mvs.geometry import Rigid3
from pano_mvs.io.colmap.reader import is_colmap_model
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.scene import Scores

_RANGES = "range"
Evaluation = TypeVar("Evaluation")


@dataclass(frozen=True, eq=False)
class RunEvaluation:
    """Scores of the results in an output folder; None for a result that cannot be compared."""

    poses: Scores | None
    depth: DepthEvaluation | None
    cloud: CloudEvaluation | None
    not_compared: Mapping[str, str]

    def __repr__(self) -> str:
        """Return the main figures, one line for each result."""
        lines = [repr(result) for result in (self.depth, self.cloud) if result is not None]
        if self.poses is not None:
            scores = self.poses.poses
            median = scores.get("median_pair_error_deg", float("nan"))  # missing if no pair could be measured
            images = f"{scores['registered']} of {scores['of']} images"
            lines.insert(0, f"poses: {images} registered, median error of a pair {median:.3g}°")
        lines += [f"{result} not compared: {reason}" for result, reason in self.not_compared.items()]
        return "\n  ".join(["RunEvaluation(", *lines]) + ")"


class _NotComparedError(Exception):
    """A result has no counterpart in the truth; the text is the reason."""


def evaluate_run(out: Path | str, truth: Path | str) -> RunEvaluation:
    """Compare the poses, the range maps and the cloud in an output folder with the truth, as far as both are there.

    Args:
        out: the output folder of a run.
        truth: a folder with poses.json and depth.npz, or a part of that.

    Raises:
        InputError: if nothing can be compared, with the reason for each result, or a file is damaged.
    """
    reasons: dict[str, str] = {}

    def attempt(result: str, compare: Callable[[Path, Path], Evaluation]) -> Evaluation | None:
        try:
            return compare(Path(out), Path(truth))
        except _NotComparedError as reason:
            reasons[result] = str(reason)
            return None

    found = attempt("poses", _poses), attempt("ranges", _ranges), attempt("cloud", _cloud)
    if len(reasons) == 3:
        raise InputError(
            f"{out}: nothing here can be compared with {truth}: {'; '.join(reasons.values())}. Give the output folder "
            "of a finished run, and a truth of its images"
        )
    return RunEvaluation(*found, reasons)


def _poses(out: Path, truth: Path) -> Scores:
    if not is_colmap_model(out / MODEL_FOLDER):
        raise _NotComparedError(f"there is no {MODEL_FOLDER}")
    try:
        known, _ = read_cameras(truth)
    except InputError as error:
        raise _NotComparedError(f"the truth has no poses ({error})") from error
    estimated: dict[str, Rigid3] = {}
    groups: dict[str, int] = {}
    for number, cameras in enumerate(camera_groups(out / "colmap")):
        estimated |= cameras
        groups |= dict.fromkeys(cameras, number)
    ours = {known_name: name for name, known_name in pair_image_names(estimated, known).items()}
    if not ours:
        raise _NotComparedError(f"the truth knows none of its images ({', '.join(list(estimated)[:3])})")
    # An image of the truth that the run did not register keeps the truth's name, and counts as not registered.
    renamed = {ours.get(name, name): pose for name, pose in known.items()}
    scores = score_capture(estimated, renamed, groups=groups)
    if not scores.poses:
        raise _NotComparedError("; ".join(scores.notes))
    return scores


def _ranges(out: Path, truth: Path) -> DepthEvaluation:
    if not is_folder(out / _RANGES):
        raise _NotComparedError(f"there is no folder {_RANGES}")
    estimates = find_ranges(out)
    try:
        true = find_true_ranges(truth)
    except InputError as error:
        raise _NotComparedError(f"the truth has none ({error})") from error
    if not pair_image_names(estimates, true):
        raise _NotComparedError(f"the truth knows none of their images ({', '.join(list(estimates)[:3])})")
    return evaluate_depth(out, truth)


def _cloud(out: Path, truth: Path) -> CloudEvaluation:
    if not is_file(out / CLOUD_FILE):
        raise _NotComparedError(f"there is no {CLOUD_FILE}")
    if not is_colmap_model(out / MODEL_FOLDER):
        raise _NotComparedError(f"there is no {MODEL_FOLDER} that defines its frame")
    try:
        if not pair_image_names(read_cameras(truth)[0], find_true_ranges(truth)):
            raise _NotComparedError("the truth has no ranges of an image whose pose it knows")
    except InputError as error:
        raise _NotComparedError(f"the truth has no ranges with poses ({error})") from error
    try:
        return evaluate_cloud(out, truth)
    except UsageError as error:
        raise _NotComparedError(str(error)) from error
