"""The options of `pano-mvs evaluate depth`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Optional

import typer
from rich.console import Console

from pano_mvs.cli.guard import guarded

_FILES = "Folder of range maps (.tiff, .exr, .npy, .npz, 16-bit .png, paired by path without extension) or .npz file"


@guarded
def evaluate_ranges(
    source: Annotated[Path, typer.Argument(help=f"The output folder of a run. {_FILES}.")],
    truth: Annotated[Path, typer.Option("--truth", help=f"Folder with poses.json and depth.npz. {_FILES}.")],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--out", help="Folder for a picture of each view's errors, scores.json and scores.csv."),
    ] = None,
    align: Annotated[
        Literal["none", "median", "lsq"], typer.Option("--align", help="Fit each view to the truth by a factor.")
    ] = "none",
    scale: Annotated[
        str, typer.Option("--scale", help="Factor to the truth's unit; auto: from the cameras' centres, if known.")
    ] = "auto",
    unit: Annotated[float, typer.Option("--unit", help="What a 1 in the files means; for millimetres 0.001.")] = 1.0,
    truth_unit: Annotated[float, typer.Option("--truth-unit", help="Likewise in the truth's files.")] = 1.0,
    peak: Annotated[float, typer.Option("--peak", help="The range that MSE and PSNR count as 1.")] = 10.0,
    bad: Annotated[
        list[str], typer.Option("--bad", help="An error above which a pixel is bad: 5%, or 0.1; may be repeated.")
    ] = ["5%"],  # noqa: B006  # typer reads it and never changes it
    min_confidence: Annotated[
        int, typer.Option("--min-confidence", min=0, max=255, help="Ranges below count as missing; 64: seen, 128: "
                          "consistent with other views.")
    ] = 0,
    masks: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--masks", help="Folder of masks <image name>.png; what is 0 is left out of all scores."),
    ] = None,
    mask: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--mask", help="One more mask, for all views: what to judge."),
    ] = None,
    images: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--images", help="Folder of the panoramas, for the pictures of the errors."),
    ] = None,
    error_limit: Annotated[
        float, typer.Option("--error-limit", help="Relative error at which the pictures' colours end.")
    ] = 0.1,
    baseline: Annotated[
        Literal["best", "median", "mean"], typer.Option("--baseline", help="Which constant stands beside each score.")
    ] = "best",
    poses: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--poses", help="The estimated poses, for the scale; else those in the output folder."),
    ] = None,
    true_poses: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--true-poses", help="The true poses, for the scale; else those in the truth's folder."),
    ] = None,
    csv: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--csv", help="Write one row for each view."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:  # fmt: skip
    """Compare range maps with the truth: MSE, PSNR, MAE, RMSE, AbsRel, δ, bad pixels, completeness, AUSE."""
    from pano_mvs.algorithms.metrics.range_errors import BadLimit
    from pano_mvs.algorithms.metrics.view_scores import Judging
    from pano_mvs.cli.evaluate_depth import DepthRequest, evaluate_depth

    judging = Judging(peak, tuple(BadLimit.from_text(text) for text in bad), align, min_confidence)
    request = DepthRequest(
        source, truth, judging, unit, truth_unit, scale, poses, true_poses, masks, mask, images, error_limit
    )
    evaluate_depth(request, Console(), out=out, csv=csv, baseline=baseline, as_json=as_json)
