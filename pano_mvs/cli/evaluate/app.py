"""Options of the commands `pano-mvs evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pano_mvs.cli.console import Console
from pano_mvs.cli.default_command import RunByDefault
from pano_mvs.cli.error_messages import guarded
from pano_mvs.cli.evaluate.depth_options import (
    AlignOption,
    BadOption,
    BaselineOption,
    CsvOption,
    ErrorLimitOption,
    EstimatesArgument,
    ImagesOption,
    MaskOption,
    MasksOption,
    MinConfidenceOption,
    OutOption,
    PeakOption,
    PosesOption,
    ScaleOption,
    TruePosesOption,
    TruthOption,
    TruthUnitOption,
    UnitOption,
)
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural

evaluate_app = typer.Typer(
    cls=RunByDefault,
    help="Compare results with ground truth; `evaluate OUT --truth DIR` means `evaluate run OUT --truth DIR`.",
    no_args_is_help=True,
)

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@evaluate_app.command("run")
@guarded
def run(
    out: Annotated[Path, typer.Argument(help="The output folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or one of them.")],
) -> None:
    """Compare the poses, range maps and cloud of a run with ground truth, as far as available."""
    from pano_mvs.cli.evaluate.printing import print_run
    from pano_mvs.evaluation import evaluate_run

    print_run(evaluate_run(out, truth), Console())


@evaluate_app.command("poses")
@guarded
def poses(
    model: Annotated[Path, typer.Argument(help="COLMAP model, poses.json, transforms.json, CSV, or output folder.")],
    truth: Annotated[Path, typer.Option("--truth", help="True poses, in any of these formats.")],
    as_json: JsonOption = False,
) -> None:
    """Compare poses with ground truth, regardless of their frames and units."""
    from pano_mvs.cli.evaluate.printing import print_json, print_summary
    from pano_mvs.evaluation import evaluate_poses

    evaluation = evaluate_poses(model, truth)
    if as_json:
        print_json(evaluation.to_json())
    else:
        print_summary(evaluation.summary(), Console())


@evaluate_app.command("cloud")
@guarded
def cloud(
    cloud: Annotated[Path, typer.Argument(help="A PLY file, or the output folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with true poses and range maps, or a PLY file.")],
    poses: Annotated[
        Path | None,
        typer.Option("--poses", help="Poses of a PLY file; default: it is in the frame of the ground truth."),
    ] = None,
    true_poses: Annotated[
        Path | None, typer.Option("--true-poses", help="True poses in the frame of a reference PLY.")
    ] = None,
    thresholds: Annotated[
        list[float], typer.Option("--threshold", help="Tolerance in the unit of the ground truth; can be repeated.")
    ] = [0.05, 0.02],  # noqa: B006  # typer reads it and never changes it
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for images, and for cloud and surface coloured by error."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="PNG file to write, with the errors in the views and from above.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare a cloud with ground truth: accuracy, completeness, F-score."""
    from pano_mvs.cli.evaluate.printing import print_json, print_line, print_summary
    from pano_mvs.evaluation import evaluate_cloud, write_error_clouds, write_overview

    evaluation = evaluate_cloud(cloud, truth, poses=poses, true_poses=true_poses, thresholds=thresholds)
    if picture is not None:
        write_overview(picture, evaluation)
    if out is not None:
        write_error_clouds(out, evaluation)
    if as_json:
        print_json(evaluation.to_json())
        return
    print_summary(evaluation.summary(), Console())
    if out is not None:
        print_line(f"accuracy.ply, completeness.ply and images of the errors are in {out}", Console())


@evaluate_app.command("depth")
@guarded
def depth(
    source: EstimatesArgument,
    truth: TruthOption,
    out: OutOption = None,
    align: AlignOption = "none",
    scale: ScaleOption = "auto",
    unit: UnitOption = 1.0,
    truth_unit: TruthUnitOption = 1.0,
    peak: PeakOption = 10.0,
    bad: BadOption = ["5%"],  # noqa: B006  # typer reads it and never changes it
    min_confidence: MinConfidenceOption = 0,
    masks: MasksOption = None,
    mask: MaskOption = None,
    images: ImagesOption = None,
    error_limit: ErrorLimitOption = 0.1,
    baseline: BaselineOption = "best",
    poses: PosesOption = None,
    true_poses: TruePosesOption = None,
    csv: CsvOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare range maps with ground truth: MSE, PSNR, MAE, RMSE, AbsRel, δ, bad pixels, completeness, AUSE."""
    from pano_mvs.cli.evaluate.printing import print_json, print_line, print_summary
    from pano_mvs.evaluation import (
        BadLimit,
        ScoreSettings,
        depth_summary,
        evaluate_depth,
        write_depth_csv,
        write_depth_pictures,
        write_depth_scores,
    )

    settings = ScoreSettings(peak, tuple(BadLimit.from_text(text) for text in bad), align, min_confidence)
    evaluation = evaluate_depth(
        source,
        truth,
        settings=settings,
        unit=unit,
        truth_unit=truth_unit,
        scale=_scale(scale),
        poses=poses,
        true_poses=true_poses,
        masks=masks,
        mask=mask,
    )
    if out is not None:
        write_depth_pictures(out, evaluation, images=images, limit=error_limit)
        write_depth_scores(out, evaluation)
    if csv is not None:
        write_depth_csv(csv, evaluation)
    if as_json:
        print_json(evaluation.to_json())
        return
    print_summary(depth_summary(evaluation, baseline=baseline), Console())
    if out is not None:
        count = len(evaluation.views)
        print_line(
            f"{count} {plural(count, 'image')} of the errors, scores.json and scores.csv are in {out}", Console()
        )


def _scale(text: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(
            f"'{text}' is not a scale: give a positive number, or auto to estimate it from the camera centres"
        ) from error
