"""Compare the output folder of a run with ground truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath

from rich.console import Console

from pano_mvs.algorithms.metrics.score import score_capture
from pano_mvs.cli.run_command import print_scores
from pano_mvs.core.errors import InputError
from pano_mvs.io.colmap_model import read_colmap_model
from pano_mvs.io.range_files import read_range_tiff
from pano_mvs.io.truth import read_truth

MODEL = "colmap/sparse/0"


def evaluate_folder(out: Path, truth_folder: Path, console: Console) -> None:
    """Print how far the poses and range maps in an output folder are from the truth.

    Raises:
        InputError: if the folder holds no model, or no image of it has truth.
    """
    if not (out / MODEL).is_dir():
        raise InputError(f"{out}: holds no {MODEL}. Give the output folder of a finished run")
    truth = read_truth(truth_folder)
    poses = read_colmap_model(out / MODEL)
    estimated = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    ours = {view.name: name for name, view in truth.match(list(estimated)).items()}
    if not ours:
        raise InputError(f"{truth_folder}: knows none of the images in {out} ({', '.join(list(estimated)[:3])} …)")
    # An image that the truth knows and the run did not register keeps the truth's name, and counts as a failure.
    true_views = {ours.get(known, known): view for known, view in truth.views.items()}
    paths = {name: path for name in ours.values() if (path := _range_path(out, name)) is not None}
    scores = score_capture(
        estimated,
        {name: view.cam_from_world for name, view in true_views.items()},
        {name: read_range_tiff(path) for name, path in paths.items()},
        {name: partial(truth.range_map, view) for name, view in true_views.items()},
    )
    print_scores({"poses": scores.poses, "views": scores.views}, console)
    for note in scores.notes:
        console.print(f"note: {note}", highlight=False)


def _range_path(out: Path, name: str) -> Path | None:
    candidates = (out / "range" / PurePosixPath(name).with_suffix(".tiff"), out / "range" / f"{name}.tiff")
    return next((path for path in candidates if path.is_file()), None)
