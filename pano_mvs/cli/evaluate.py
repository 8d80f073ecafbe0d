"""Compare all that is in the output folder of a run with ground truth."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.algorithms.metrics.score import score_capture
from pano_mvs.algorithms.metrics.view_scores import Judging
from pano_mvs.cli.console import Console
from pano_mvs.cli.evaluate_cloud import CloudRequest, evaluate_cloud
from pano_mvs.cli.evaluate_depth import DepthRequest, evaluate_depth
from pano_mvs.cli.run.printing import print_scores
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.geometry import Rigid3
from pano_mvs.io.colmap.model import is_colmap_model
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.io.ranges.folders import find_ranges, match_pictures
from pano_mvs.io.truth import find_true_ranges
from pano_mvs.results.records import ScoresSummary

MODEL_ABOVE, MODEL, CLOUD, RANGES = "colmap", "colmap/sparse/0", "cloud.ply", "range"


def evaluate_folder(out: Path, truth: Path, console: Console) -> None:
    """Print how far the poses, the range maps and the cloud in an output folder are from the truth.

    What is not there, on either side, is left out with a line that says so.

    Raises:
        InputError: if nothing can be compared, with what is missing for each, or a file is damaged.
    """
    reasons = {"poses": _poses(out, truth, console), "ranges": _ranges(out, truth, console),
               "cloud": _cloud(out, truth, console)}  # fmt: skip
    if all(reasons.values()):
        raise InputError(f"{out}: nothing here can be compared with {truth}: "
                         f"{'; '.join(reason for reason in reasons.values() if reason)}. Give the output folder of a "
                         "finished run, and a truth that knows its pictures")  # fmt: skip
    for what, reason in reasons.items():
        if reason:
            console.print(f"{what}: not compared, {reason}", highlight=False, markup=False, soft_wrap=True)


def _poses(out: Path, truth: Path, console: Console) -> str:
    """Print the scores of the poses; return why not, or an empty text."""
    if not is_colmap_model(out / MODEL):
        return f"there is no {MODEL}"
    try:
        true = _cameras(truth)
    except InputError as error:
        return f"the truth has no poses ({error})"
    estimated: dict[str, Rigid3] = {}
    groups: dict[str, int] = {}
    for number, group in enumerate(read_groups(out / MODEL_ABOVE)):
        estimated |= {name: group.cam_from_world(idx) for idx, name in enumerate(group.names)}
        groups |= dict.fromkeys(group.names, number)
    ours = {known: name for name, known in match_pictures(estimated, true).items()}
    if not ours:
        return f"the truth knows none of its images ({', '.join(list(estimated)[:3])})"
    # An image that the truth knows and the run did not register keeps the truth's name, and counts as a failure.
    scores = score_capture(estimated, {ours.get(known, known): pose for known, pose in true.items()}, {}, {},
                           groups=groups)  # fmt: skip
    print_scores(ScoresSummary(poses=scores.poses), console)
    if "registered_in_one_frame" in scores.poses:
        console.print(scores.notes[0], highlight=False, markup=False, soft_wrap=True)
    return "" if scores.poses else "; ".join(scores.notes)


def _ranges(out: Path, truth: Path, console: Console) -> str:
    """Print the scores of the range maps; return why not, or an empty text."""
    if not is_folder(out / RANGES):
        return f"there is no folder {RANGES}"
    estimates = find_ranges(out)
    try:
        true = find_true_ranges(truth)
    except InputError as error:
        return f"the truth has none ({error})"
    if not match_pictures(estimates, true):
        return f"the truth knows none of their pictures ({', '.join(list(estimates)[:3])})"
    request = DepthRequest(out, truth, Judging())
    evaluate_depth(request, console, out=None, csv=None, baseline="best", as_json=False)
    return ""


def _cloud(out: Path, truth: Path, console: Console) -> str:
    """Print the scores of the cloud; return why not, or an empty text."""
    if not is_file(out / CLOUD):
        return f"there is no {CLOUD}"
    if not is_colmap_model(out / MODEL):
        return f"there is no {MODEL} that tells in which frame it is"
    try:
        if not match_pictures(_cameras(truth), find_true_ranges(truth)):
            return "the truth has no ranges of a picture whose pose it knows"
    except InputError as error:
        return f"the truth has no ranges with poses ({error})"
    try:
        evaluate_cloud(CloudRequest(out, truth), console, as_json=False)
    except UsageError as error:
        return str(error)
    return ""


def _cameras(path: Path) -> dict[str, Rigid3]:
    poses = read_poses(path)
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
