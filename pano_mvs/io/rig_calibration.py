"""Read and write the calibration of a rig of two fisheye lenses as a YAML file.

    model: kannala_brandt
    first_pixel_px: 0.5
    lenses:
      front:
        image_size_px: [1920, 1920]
        focal_px: [545.2, 544.9]
        principal_point_px: [961.3, 957.8]
        distortion: [0.0213, -0.0047, 0.0011, -0.0003]
        field_of_view_deg: 196
        lens_from_rig: {rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 0]}
      back: …

docs/rigs.md describes the keys and their conventions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from pano_mvs.core.errors import InputError, UsageError, WorkflowError
from pano_mvs.core.yaml_text import Problems, parse_yaml, report_invalid
from pano_mvs.geometry import FisheyeLens, LensRig, Rigid3, nearest_rotation, rotation_from_quat_wxyz
from pano_mvs.scene import FilePart

Model = Literal["kannala_brandt", "opencv_fisheye"]
MODELS: tuple[Model, ...] = get_args(Model)
GUIDE = "docs/rigs.md shows a complete file and where the numbers come from"

_MAX_BYTES = 1 << 20  # of a larger file, YAML takes minutes
_Number = Annotated[float, Field(strict=True)]
_Pixels = Annotated[_Number, Field(ge=1, multiple_of=1)]
_Pair = tuple[_Number, _Number]
_Triple = tuple[_Number, _Number, _Number]
_Quadruple = tuple[_Number, _Number, _Number, _Number]
_MAX_TURN_ERROR = 1e-3


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Pose(_Keys):
    """The pose of a lens; its rotation is a matrix or a quaternion."""

    rotation: tuple[_Triple, _Triple, _Triple] | None = None
    rotation_wxyz: _Quadruple | None = None
    translation_m: _Triple

    @model_validator(mode="after")
    def _check(self) -> _Pose:
        if (self.rotation is None) == (self.rotation_wxyz is None):
            raise ValueError("must have the keys rotation_wxyz or rotation, and translation_m")
        if np.linalg.norm(self.translation_m) > 10:
            raise ValueError("translation_m is more than 10 metres. Is it in millimetres?")
        if self.rotation_wxyz is not None and abs(np.linalg.norm(self.rotation_wxyz) - 1) > _MAX_TURN_ERROR:
            raise ValueError("the length of the quaternion is not 1")
        if self.rotation is not None:
            matrix = np.array(self.rotation)
            if np.abs(matrix @ matrix.T - np.eye(3)).max() > _MAX_TURN_ERROR or np.linalg.det(matrix) < 0:
                raise ValueError("rotation is not a rotation matrix: its rows must be orthonormal, its determinant 1")
        return self

    @property
    def transform(self) -> Rigid3:
        """The lens_from_rig."""
        if self.rotation is not None:
            return Rigid3(nearest_rotation(np.array(self.rotation)), np.array(self.translation_m))
        quaternion = np.array(self.rotation_wxyz)
        rotation = rotation_from_quat_wxyz(quaternion / np.linalg.norm(quaternion))
        return Rigid3(rotation, np.array(self.translation_m))


class _Lens(_Keys):
    """The numbers of a lens, by the names of docs/rigs.md."""

    image_size_px: tuple[_Pixels, _Pixels]
    focal_px: tuple[Annotated[_Number, Field(gt=0)], Annotated[_Number, Field(gt=0)]]
    principal_point_px: _Pair
    distortion: _Quadruple
    field_of_view_deg: Annotated[_Number, Field(gt=0, le=360)]
    lens_from_rig: _Pose

    @field_validator("principal_point_px")
    @classmethod
    def _is_inside(cls, point: _Pair, known: ValidationInfo) -> _Pair:
        width, height = known.data.get("image_size_px", (np.inf, np.inf))
        if not (0 <= point[0] <= width and 0 <= point[1] <= height):
            raise ValueError(f"is outside of the picture of {width:.0f}×{height:.0f} pixels")
        return point

    @model_validator(mode="after")
    def _can_be_projected(self) -> _Lens:
        try:
            self.lens(0.0)
        except UsageError as error:
            raise ValueError(f"distortion: {error}. Check the numbers, or state a smaller field_of_view_deg") from error
        return self

    def lens(self, shift_px: float) -> FisheyeLens:
        """Return the lens; the shift is added to the principal point."""
        width, height = self.image_size_px
        center = self.principal_point_px[0] + shift_px, self.principal_point_px[1] + shift_px
        half = float(np.radians(self.field_of_view_deg / 2))
        return FisheyeLens((int(height), int(width)), self.focal_px, center, self.distortion, half)


class _Calibration(_Keys):
    model: Model
    first_pixel_px: _Number
    metric: Annotated[bool, Field(strict=True)] = True
    lenses: Annotated[
        dict[Annotated[str, Field(pattern="^[A-Za-z0-9-]{1,40}$")], _Lens], Field(min_length=2, max_length=2)
    ]

    @field_validator("first_pixel_px")
    @classmethod
    def _is_known(cls, first_pixel: float) -> float:
        if first_pixel not in (0, 0.5):
            raise ValueError("must be 0.5 (COLMAP) or 0 (OpenCV, Kalibr): the position of the first pixel's centre")
        return first_pixel


def read_rig(file: FilePart, *, stitch_distance_m: float = float("inf"), blend_deg: float = 2.0) -> LensRig:
    """Return the rig that a calibration file describes.

    Args:
        stitch_distance_m: the distance at which the pictures are stitched.
        blend_deg: width of the strip around the seam in which both pictures are mixed.

    Raises:
        InputError: if the file cannot be read, or a number is missing or impossible; with file, line and remedy.
    """
    stated = _parsed(file)
    (first_name, first), (second_name, second) = stated.lenses.items()
    shift_px = 0.5 - stated.first_pixel_px
    try:
        return LensRig.centred(
            (first_name, second_name),
            (first.lens(shift_px), second.lens(shift_px)),
            (first.lens_from_rig.transform, second.lens_from_rig.transform),
            stitch_distance_m=stitch_distance_m,
            blend_deg=blend_deg,
            metric=stated.metric,
        )
    except UsageError as error:
        raise InputError(f"{file.path}: {error}. Give a larger stitch_distance_m, or translations in metres") from error


def _parsed(file: FilePart) -> _Calibration:
    problems, data = Problems(), file.read_bytes()
    if len(data) > _MAX_BYTES:
        raise InputError(f"{file.path}: too large for a calibration file ({len(data)} bytes). {GUIDE}")
    try:
        root = parse_yaml(data.decode("utf-8-sig", "replace"), str(file.path))
        try:
            return _Calibration.model_validate(root.plain())
        except ValidationError as error:
            report_invalid(error, root, problems, model=_Calibration)
            problems.raise_if_any()
            raise
    except WorkflowError as error:
        raise InputError(f"{error}\n{GUIDE}") from error


def calibration_text(rig: LensRig, *, comments: Sequence[str] = ()) -> str:
    """Return the calibration file of a rig, which `read_rig` reads without loss of precision.

    Args:
        rig: the rig; the poses of its lenses are written in its own frame.
        comments: lines at the beginning of the file.
    """
    lines = [*(f"# {comment}" for comment in comments), f"model: {MODELS[0]}", "first_pixel_px: 0.5"]
    if not rig.metric:
        lines.append("metric: false")
    lines.append("lenses:")
    for name, lens, pose in zip(rig.names, rig.lenses, rig.lens_from_rig, strict=True):
        height, width = lens.size_hw
        lines += [
            f"  {name}:",
            f"    image_size_px: [{width}, {height}]",
            f"    focal_px: {list(lens.focal_xy)}",
            f"    principal_point_px: {list(lens.principal_xy)}",
            f"    distortion: {list(lens.distortion)}",
            f"    field_of_view_deg: {float(np.degrees(2 * lens.max_angle_rad))!r}",
            "    lens_from_rig:",
            f"      rotation: {pose.rotation.tolist()}",
            f"      translation_m: {pose.translation.tolist()}",
        ]
    return "\n".join(lines) + "\n"
