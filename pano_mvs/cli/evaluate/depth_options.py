"""Options of `pano-mvs evaluate depth`. Typer reads one parameter of the command for each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

_FILES = "a folder of range maps (.tiff, .exr, .npy, .npz, 16-bit .png; paired by path), or an .npz file"

EstimatesArgument = Annotated[Path, typer.Argument(help=f"The output folder of a run, {_FILES}.")]
TruthOption = Annotated[Path, typer.Option("--truth", help="Folder with poses.json and depth.npz, or any of these.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for pictures of the errors, scores.json and scores.csv.")
]
AlignOption = Annotated[
    Literal["none", "median", "lsq"], typer.Option("--align", help="Fit each view to the truth by a factor.")
]
ScaleOption = Annotated[
    str, typer.Option("--scale", help="Factor to the truth's unit; auto: from the camera centres, if known.")
]
UnitOption = Annotated[float, typer.Option("--unit", help="Unit of the files' numbers; 0.001 for mm.")]
TruthUnitOption = Annotated[float, typer.Option("--truth-unit", help="Unit of the truth's numbers.")]
PeakOption = Annotated[float, typer.Option("--peak", help="The range that MSE and PSNR count as 1.")]
BadOption = Annotated[
    list[str], typer.Option("--bad", help="An error above which a pixel is bad: 5%, or 0.1; may be repeated.")
]
MinConfidenceOption = Annotated[
    int,
    typer.Option(
        "--min-confidence",
        min=0,
        max=255,
        help="Ranges of lower confidence count as missing; 64: seen, 128: consistent with other views.",
    ),
]
MasksOption = Annotated[
    Path | None, typer.Option("--masks", help="Folder of masks <image name>.png; pixels where it is 0 are ignored.")
]
MaskOption = Annotated[
    Path | None, typer.Option("--mask", help="Evaluate only pixels inside this mask (applied to every view).")
]
ImagesOption = Annotated[
    Path | None, typer.Option("--images", help="Folder of the panoramas, for the pictures of the errors.")
]
ErrorLimitOption = Annotated[
    float, typer.Option("--error-limit", help="Relative error at which the colours of the pictures end.")
]
BaselineOption = Annotated[
    Literal["best", "median", "mean"], typer.Option("--baseline", help="Which constant is shown beside each score.")
]
PosesOption = Annotated[
    Path | None, typer.Option("--poses", help="The estimated poses, for the scale; default: the output folder's.")
]
TruePosesOption = Annotated[
    Path | None, typer.Option("--true-poses", help="The true poses, for the scale; default: the truth folder's.")
]
CsvOption = Annotated[Path | None, typer.Option("--csv", help="Write one row for each view.")]
