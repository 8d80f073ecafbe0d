"""Options of the commands `pano-mvs evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import typer
from rich.markup import escape
from typer.core import TyperGroup

from pano_mvs.cli.commands import load_files
from pano_mvs.cli.console import Console, print_json
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import takes_record
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural

_FILES = "a folder of range maps (.tiff, .exr, .npy, .npz, 16-bit .png; paired by path), or an .npz file"


class RunByDefault(TyperGroup):
    """Takes `group X …` for `group run X …` unless X is one of its commands."""

    default: ClassVar[str] = "run"

    # The context is click's, whose module differs between versions of typer.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if the arguments name none, except when they ask for help."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [self.default, *args]
        return super().parse_args(ctx, args)


evaluate_app = typer.Typer(
    cls=RunByDefault,
    help="Compare results with ground truth; `evaluate OUT --truth DIR` means `evaluate run OUT --truth DIR`.",
    no_args_is_help=True,
)

# Options by the panel of the help in which they are listed.
_scale_option = partial(typer.Option, rich_help_panel="Scale and units")
_score_option = partial(typer.Option, rich_help_panel="Scores")
_mask_option = partial(typer.Option, rich_help_panel="Masks")
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@evaluate_app.callback()
def with_readers() -> None:
    """Import the user's plugin files, which may read the poses of the ground truth."""
    load_files()


@evaluate_app.command("run")
@guarded
def run(
    out: Annotated[Path, typer.Argument(help="The output folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or one of them.")],
) -> None:
    """Compare the poses, range maps and cloud of a run with ground truth, as far as available."""
    from pano_mvs_evaluation.capture import evaluate_run
    from pano_mvs_evaluation.printing import print_run

    print_run(evaluate_run(out, truth), Console())


@evaluate_app.command("poses")
@guarded
def poses(
    model: Annotated[Path, typer.Argument(help="COLMAP model, poses.json, transforms.json, CSV, or output folder.")],
    truth: Annotated[Path, typer.Option("--truth", help="True poses, in any of these formats.")],
    as_json: JsonOption = False,
) -> None:
    """Compare poses with ground truth, regardless of their frames and units."""
    from pano_mvs_evaluation.poses import evaluate_poses
    from pano_mvs_evaluation.printing import print_summary

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
    from pano_mvs_evaluation.clouds.evaluate import evaluate_cloud
    from pano_mvs_evaluation.clouds.pictures import write_error_clouds, write_overview
    from pano_mvs_evaluation.printing import print_summary

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
        Console().say(escape(f"accuracy.ply, completeness.ply and images of the errors are in {out}"))


@dataclass(frozen=True)
class DepthArguments:
    """The arguments and options of `pano-mvs evaluate depth`."""

    source: Annotated[Path, typer.Argument(help=f"The output folder of a run, {_FILES}.")]
    truth: Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or any of these.")]
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for images of the errors, scores.json and scores.csv."),
    ] = None
    align: Annotated[
        Literal["none", "median", "lsq"], _scale_option("--align", help="Fit each view to its truth by one factor.")
    ] = "none"
    scale: Annotated[
        str, _scale_option("--scale", help="Factor to the unit of the ground truth; auto: from the camera centres.")
    ] = "auto"
    unit: Annotated[float, _scale_option("--unit", help="Unit of the estimated ranges; 0.001 for mm.")] = 1.0
    truth_unit: Annotated[float, _scale_option("--truth-unit", help="Unit of the true ranges.")] = 1.0
    peak: Annotated[float, _score_option("--peak", help="Peak of MSE and PSNR, a range.")] = 10.0
    bad: Annotated[
        list[str] | None,
        _score_option(
            "--bad", help="Error above which a pixel is bad, such as 5% or 0.1; can be repeated. Default: 5%."
        ),
    ] = None
    min_confidence: Annotated[
        int,
        _score_option(
            "--min-confidence",
            min=0,
            max=255,
            help="Ranges of lower confidence count as missing; 64: seen, 128: consistent.",
        ),
    ] = 0
    masks: Annotated[Path | None, _mask_option("--masks", help="Folder of masks <image name>.png; 0 is ignored.")] = (
        None
    )
    mask: Annotated[
        Path | None, _mask_option("--mask", help="Mask for all views; pixels with value 0 are ignored.")
    ] = None
    images: Annotated[
        Path | None, typer.Option("--images", help="Folder of the panoramas, for the images of the errors.")
    ] = None
    error_limit: Annotated[
        float, _score_option("--error-limit", help="Relative error at the end of the colour scale.")
    ] = 0.1
    baseline: Annotated[
        Literal["best", "median", "mean"], _score_option("--baseline", help="Constant range to compare with.")
    ] = "best"
    poses: Annotated[
        Path | None, _scale_option("--poses", help="Estimated poses, for the scale; default: of the output folder.")
    ] = None
    true_poses: Annotated[
        Path | None,
        _scale_option("--true-poses", help="True poses, for the scale; default: those of the ground truth."),
    ] = None
    csv: Annotated[Path | None, typer.Option("--csv", help="CSV file to write, with one row per view.")] = None
    as_json: JsonOption = False


@evaluate_app.command("depth")
@guarded
@takes_record
def depth(given: DepthArguments) -> None:
    """Compare range maps with ground truth: MSE, PSNR, MAE, RMSE, AbsRel, δ, bad pixels, completeness, AUSE."""
    from pano_mvs_evaluation.printing import print_summary
    from pano_mvs_evaluation.ranges.error_picture import write_depth_pictures
    from pano_mvs_evaluation.ranges.evaluate import evaluate_depth
    from pano_mvs_evaluation.ranges.tables import depth_summary, write_depth_csv, write_depth_scores
    from pano_mvs_evaluation.ranges.view_scores import BadLimit, ScoreSettings

    settings = ScoreSettings(
        given.peak, tuple(BadLimit.from_text(text) for text in given.bad or ["5%"]), given.align, given.min_confidence
    )
    evaluation = evaluate_depth(
        given.source,
        given.truth,
        settings=settings,
        unit=given.unit,
        truth_unit=given.truth_unit,
        scale=_scale(given.scale),
        poses=given.poses,
        true_poses=given.true_poses,
        masks=given.masks,
        mask=given.mask,
    )
    if given.out is not None:
        write_depth_pictures(given.out, evaluation, images=given.images, limit=given.error_limit)
        write_depth_scores(given.out, evaluation)
    if given.csv is not None:
        write_depth_csv(given.csv, evaluation)
    if given.as_json:
        print_json(evaluation.to_json())
        return
    print_summary(depth_summary(evaluation, baseline=given.baseline), Console())
    if given.out is not None:
        count = len(evaluation.views)
        images_text = f"{count} {plural(count, 'image')} of the errors"
        Console().say(escape(f"{images_text}, scores.json and scores.csv are in {given.out}"))


def _scale(text: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(
            f"'{text}' is not a scale: give a positive number, or auto to estimate it from the camera centres"
        ) from error
