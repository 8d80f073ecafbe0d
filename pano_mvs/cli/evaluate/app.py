"""The commands `pano-mvs evaluate …`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Optional

import typer

from pano_mvs.cli.console import Console
from pano_mvs.cli.default_command import RunByDefault
from pano_mvs.cli.guard import guarded

evaluate_app = typer.Typer(
    cls=RunByDefault,
    help="Compare with the truth; `evaluate OUT --truth DIR` is `evaluate run OUT --truth DIR`.",
    no_args_is_help=True,
)

_FILES = "a folder of range maps (.tiff, .exr, .npy, .npz, 16-bit .png; paired by path), or an .npz file"


@evaluate_app.command("run")
@guarded
def evaluate_run(
    out: Annotated[Path, typer.Argument(help="The output folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or a part of that.")],
) -> None:
    """Compare a run's poses, range maps and cloud with the truth, as far as both are there."""
    from pano_mvs.cli.evaluate.run import evaluate_folder

    evaluate_folder(out, truth, Console())


@evaluate_app.command("poses")
@guarded
def evaluate_model(
    model: Annotated[Path, typer.Argument(help="COLMAP model, poses.json, transforms.json, CSV, or a run's output.")],
    truth: Annotated[Path, typer.Option("--truth", help="The true poses, in any of these forms.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare the poses in any file with the truth, whatever their frames and units."""
    from pano_mvs.cli.evaluate.poses import evaluate_poses

    evaluate_poses(model, truth, Console(), as_json=as_json)


@evaluate_app.command("cloud")
@guarded
def evaluate_points(
    cloud: Annotated[Path, typer.Argument(help="A PLY file, or the output folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses and range maps, or a reference PLY.")],
    poses: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--poses", help="The poses it was made with; without, a PLY lies in the truth's frame."),
    ] = None,
    true_poses: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--true-poses", help="The true poses in the frame of a reference PLY."),
    ] = None,
    thresholds: Annotated[
        list[float], typer.Option("--threshold", help="A tolerance in the truth's unit; may be given repeatedly.")
    ] = [0.05, 0.02],  # noqa: B006  # typer reads it and never changes it
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--out", help="Folder for the cloud and the surface coloured by their errors, and pictures."),
    ] = None,
    picture: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--picture", help="A PNG to write of where the errors are, in the views and from above."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare a cloud with the true surface: accuracy, completeness, F-score."""
    from pano_mvs.cli.evaluate.cloud import CloudRequest, evaluate_cloud

    request = CloudRequest(cloud, truth, poses, true_poses, tuple(thresholds))
    evaluate_cloud(request, Console(), out=out, picture=picture, as_json=as_json)


@evaluate_app.command("depth")
@guarded
def evaluate_ranges(
    source: Annotated[Path, typer.Argument(help=f"The output folder of a run, {_FILES}.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or any of these.")],
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
    from pano_mvs.cli.evaluate.depth import DepthRequest, evaluate_depth
    from pano_mvs.evaluation.ranges.errors import BadLimit
    from pano_mvs.evaluation.ranges.view_scores import Judging

    judging = Judging(peak, tuple(BadLimit.from_text(text) for text in bad), align, min_confidence)
    request = DepthRequest(
        source, truth, judging, unit, truth_unit, scale, poses, true_poses, masks, mask, images, error_limit
    )
    evaluate_depth(request, Console(), out=out, csv=csv, baseline=baseline, as_json=as_json)
