"""Options of `pano-mvs evaluate depth`. Typer reads one parameter of the command for each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

_FILES = "a folder of range maps (.tiff, .exr, .npy, .npz, 16-bit .png; paired by path), or an .npz file"

EstimatesArgument = Annotated[Path, typer.Argument(help=f"The output folder of a run, {_FILES}.")]
TruthOption = Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or any of these.")]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for images of the errors, scores.json and scores.csv."),
]
AlignOption = Annotated[
    Literal["none", "median", "lsq"], typer.Option("--align", help="Fit each view to its truth by one factor.")
]
ScaleOption = Annotated[
    str, typer.Option("--scale", help="Factor to the unit of the ground truth; auto: from the camera centres.")
]
UnitOption = Annotated[float, typer.Option("--unit", help="Unit of the estimated ranges; 0.001 for mm.")]
TruthUnitOption = Annotated[float, typer.Option("--truth-unit", help="Unit of the true ranges.")]
PeakOption = Annotated[float, typer.Option("--peak", help="Peak of MSE and PSNR, a range.")]
BadOption = Annotated[
    list[str], typer.Option("--bad", help="Error above which a pixel is bad, such as 5% or 0.1; can be repeated.")
]
MinConfidenceOption = Annotated[
    int,
    typer.Option(
        "--min-confidence",
        min=0,
        max=255,
        help="Ranges of lower confidence count as missing; 64: seen, 128: consistent.",
    ),
]
MasksOption = Annotated[Path | None, typer.Option("--masks", help="Folder of masks <image name>.png; 0 is ignored.")]
MaskOption = Annotated[Path | None, typer.Option("--mask", help="Mask for all views; pixels with value 0 are ignored.")]
ImagesOption = Annotated[
    Path | None, typer.Option("--images", help="Folder of the panoramas, for the images of the errors.")
]
ErrorLimitOption = Annotated[
    float, typer.Option("--error-limit", help="Relative error at the end of the colour scale.")
]
BaselineOption = Annotated[
    Literal["best", "median", "mean"], typer.Option("--baseline", help="Constant range to compare with.")
]
PosesOption = Annotated[
    Path | None, typer.Option("--poses", help="Estimated poses, for the scale; default: of the output folder.")
]
TruePosesOption = Annotated[
    Path | None, typer.Option("--true-poses", help="True poses, for the scale; default: those of the ground truth.")
]
CsvOption = Annotated[Path | None, typer.Option("--csv", help="CSV file to write, with one row per view.")]
