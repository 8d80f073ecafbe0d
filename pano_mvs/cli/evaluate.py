"""Compare the output folder of a run with ground truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from pano_mvs.algorithms.metrics.score import score_capture
from pano_mvs.cli.run_command import print_scores
from pano_mvs.core.errors import InputError
from pano_mvs.io.colmap_model import read_colmap_model
from pano_mvs.io.range_files import read_confidence_png, read_range_tiff
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
    paths = {name: path for name in ours.values() if (path := _written(out, "range", name, ".tiff")) is not None}
    scores = score_capture(
        estimated,
        {name: view.cam_from_world for name, view in true_views.items()},
        {name: read_range_tiff(path) for name, path in paths.items()},
        {name: partial(truth.range_map, view) for name, view in true_views.items()},
        confidences=_confidences(out, list(paths)),
    )
    print_scores({"poses": scores.poses, "views": scores.views}, console)
    for note in scores.notes:
        console.print(f"note: {note}", highlight=False)


def _confidences(out: Path, names: list[str]) -> dict[str, NDArray[np.uint8]]:
    """Return the confidences, (H, W) by image, of those images that have any."""
    paths = {name: _written(out, "confidence", name, ".png") for name in names}
    return {name: read_confidence_png(path) for name, path in paths.items() if path is not None}


def _written(out: Path, folder: str, name: str, suffix: str) -> Path | None:
    candidates = (out / folder / PurePosixPath(name).with_suffix(suffix), out / folder / f"{name}{suffix}")
    return next((path for path in candidates if path.is_file()), None)
