"""Compare range maps with true ones: scores, what constants score, and pictures of the errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from pano_mvs.algorithms.metrics.resize import resized_labels, resized_range
from pano_mvs.algorithms.metrics.view_scores import Judging, ViewScores, score_view
from pano_mvs.cli.evaluate_depth_inputs import (
    DepthInputs,
    FoundScale,
    find_inputs,
    find_scale,
    mask_reader,
    picture_reader,
    views_without_mask,
)
from pano_mvs.cli.evaluate_depth_print import DepthReport, print_report, report_json, write_csv
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.files import write_text
from pano_mvs.core.text import plural
from pano_mvs.io.error_picture import write_error_picture


@dataclass(frozen=True)
class DepthRequest:
    """What `evaluate depth` is asked for.

    Attributes:
        source: output folder of a run, folder of range maps, or .npz file.
        truth: folder with poses.json and depth.npz, or as `source`.
        judging: how range maps are judged.
        unit: what a 1 in the files of `source` stands for.
        truth_unit: likewise of the truth.
        scale: from the one's unit to the other's, or "auto": from the cameras' centres.
        poses: estimated poses, if not those in `source`.
        true_poses: true poses, if not those beside the truth.
        masks: folder of masks; 0 is left out.
        mask: one mask for all.
        images: folder of the panoramas, for the pictures.
        error_limit: relative error at which the pictures' scale ends.
    """

    source: Path
    truth: Path
    judging: Judging
    unit: float = 1.0
    truth_unit: float = 1.0
    scale: str = "auto"
    poses: Path | None = None
    true_poses: Path | None = None
    masks: Path | None = None
    mask: Path | None = None
    images: Path | None = None
    error_limit: float = 0.1


def evaluate_depth(
    request: DepthRequest, console: Console, *, out: Path | None, csv: Path | None, baseline: str, as_json: bool
) -> None:
    """Print how far range maps are from the truth, beside what constants score.

    Args:
        request: what is compared, and how.
        console: where to print.
        out: folder for a picture of each view's errors, scores.json and scores.csv; None: nowhere.
        csv: where to write one row for each view; None: nowhere.
        baseline: which constant is printed: "best", "median" or "mean".
        as_json: print one JSON object and nothing else.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if an option cannot work.
    """
    report = judge_depth(request, pictures=out)
    if out is not None:
        write_text(out / "scores.json", report_json(report))
        write_csv(out / "scores.csv", report)
    if csv is not None:
        csv.parent.mkdir(parents=True, exist_ok=True)
        write_csv(csv, report)
    if as_json:
        print(report_json(report))
        return
    print_report(report, console, baseline=baseline)
    if out is not None:
        count = len(report.views)
        text = f"{count} {plural(count, 'picture')} of the errors, scores.json and scores.csv are in {out}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def judge_depth(request: DepthRequest, *, pictures: Path | None = None) -> DepthReport:
    """Return the scores of all range maps that have truth, and write the pictures of their errors if asked to.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if an option cannot work.
    """
    for what, value in (("--unit", request.unit), ("--truth-unit", request.truth_unit),
                        ("--error-limit", request.error_limit)):  # fmt: skip
        if not 0 < value < float("inf"):
            raise UsageError(f"{what} must be a positive number, got {value}")
    inputs = find_inputs(request.source, request.truth, unit=request.unit, truth_unit=request.truth_unit)
    scale = find_scale(request.source, request.truth, request.scale, request.poses, request.true_poses)
    views: dict[str, ViewScores] = {}
    sizes: dict[tuple[tuple[int, int], tuple[int, int]], int] = {}
    read_picture = picture_reader(request.images, request.truth, inputs) if pictures is not None else None
    for view in _views(request, inputs, scale):
        views[view.name] = view.scores
        sizes[view.sizes] = sizes.get(view.sizes, 0) + 1
        if pictures is not None and read_picture is not None:
            image = read_picture(view.name)
            path = pictures / f"{view.name}.jpg"
            write_error_picture(path, view.estimated, view.truth, image=image, counted=view.counted,
                                limit=request.error_limit)  # fmt: skip
    if not any(view.pixels for view in views.values()):
        raise InputError(f"{request.truth}: no pixel of any view has a true range that counts. Look at its files and "
                         "at the masks: zero, negative, infinite and NaN are no range")  # fmt: skip
    return DepthReport(str(request.source), str(request.truth), request.judging, scale, views, inputs.without_truth,
                       inputs.without_estimate, sizes, views_without_mask(request.masks, views))  # fmt: skip


@dataclass(frozen=True, eq=False)
class _View:
    """One view, judged: its maps in the truth's unit and size, and (height, width) of estimate and truth."""

    name: str
    scores: ViewScores
    estimated: NDArray[np.float32]
    truth: NDArray[np.float32]
    counted: NDArray[np.bool_] | None
    sizes: tuple[tuple[int, int], tuple[int, int]]


def _views(request: DepthRequest, inputs: DepthInputs, scale: FoundScale) -> Iterator[_View]:
    """Judge one view after the other."""
    mask_of = mask_reader(request.masks, request.mask, inputs.truths)
    least = request.judging.min_confidence
    scales = scale.of_views(inputs.truths)
    for name, true_file in inputs.truths.items():
        if name not in scales:
            continue
        file, truth = inputs.estimates[name], true_file.read()
        found, confidence = file.read(), file.read_confidence()
        if least and confidence is None:
            raise InputError(f"{file.path}: no confidence/{name}.png beside it, so --min-confidence cannot be kept. "
                             "Leave it out, or give the output folder of a run")  # fmt: skip
        size_hw = truth.shape[0], truth.shape[1]
        try:
            estimated = resized_range(found, size_hw)
            confidence = None if confidence is None else resized_labels(confidence, size_hw)
            counted = mask_of(name, size_hw)
        except UsageError as error:
            error.add_note(f"view {name}: {file.path} against {true_file.path}")
            raise InputError(f"{file.path} against {true_file.path}: {error}") from error
        scores = score_view(estimated, truth, confidence=confidence, scale=scales[name], mask=counted,
                            judging=request.judging)  # fmt: skip
        if least and confidence is not None:
            estimated = np.where(confidence >= least, estimated, np.float32(np.nan))
        sizes = (found.shape[0], found.shape[1]), size_hw
        yield _View(name, scores, (estimated * scores.scale).astype(np.float32), truth, counted, sizes)
