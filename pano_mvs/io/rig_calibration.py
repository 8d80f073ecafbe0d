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

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import FisheyeLens, LensRig, Rigid3, nearest_rotation, rotation_from_quat_wxyz
from pano_mvs.scene import FilePart

MODELS = ("kannala_brandt", "opencv_fisheye")
GUIDE = "docs/rigs.md shows a complete file and where the numbers come from"

_MAX_TURN_ERROR = 1e-3
_LENS_KEYS = (
    "image_size_px",
    "focal_px",
    "principal_point_px",
    "distortion",
    "field_of_view_deg",
    "lens_from_rig",
)
_PLAIN_NAME = re.compile(r"[A-Za-z0-9-]{1,40}")


def read_rig(file: FilePart, *, stitch_distance_m: float = float("inf"), blend_deg: float = 2.0) -> LensRig:
    """Return the rig that a calibration file describes.

    Args:
        stitch_distance_m: the distance at which the pictures are stitched.
        blend_deg: width of the strip around the seam in which both pictures are mixed.

    Raises:
        InputError: if the file cannot be read, or a number is missing or impossible; with file, line and remedy.
    """
    place = _Place(file.path)
    root = _parsed(file, place)
    place.require_keys(root, ("model", "first_pixel_px", "lenses"), optional=("metric",))
    metric = root.get("metric", True)
    if not isinstance(metric, bool):
        place.fail(root, "metric", "must be true, or false if the length of the translations is only assumed")
    model = root["model"]
    if model not in MODELS:
        place.fail(root, "model", f"unknown model {model!r}. Supported: {', '.join(MODELS)} (the same model)")
    first_pixel = root["first_pixel_px"]
    if first_pixel not in (0, 0.5):
        place.fail(
            root,
            "first_pixel_px",
            "must be 0.5 (COLMAP) or 0 (OpenCV, Kalibr): the position of the first pixel's centre",
        )
    lenses = root["lenses"]
    if not isinstance(lenses, CommentedMap) or len(lenses) != 2:
        place.fail(root, "lenses", "must contain two lenses, such as front and back")
    names = list(lenses)
    for name in names:
        if not isinstance(name, str) or not _PLAIN_NAME.fullmatch(name):
            place.fail(lenses, name, f"the name {name!r} of a lens must consist of letters, digits and -")
        if not isinstance(lenses[name], CommentedMap):
            place.fail(lenses, name, "a lens must be a mapping of settings")
    first, second = (_lens(lenses[name], place, shift_px=0.5 - first_pixel) for name in names)
    try:
        return LensRig.centred(
            (names[0], names[1]),
            (first[0], second[0]),
            (first[1], second[1]),
            stitch_distance_m=stitch_distance_m,
            blend_deg=blend_deg,
            metric=metric,
        )
    except UsageError as error:
        raise InputError(f"{file.path}: {error}. Give a larger stitch_distance_m, or translations in metres") from error


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


class _Place:
    """Errors with the file, line and column of a value."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def fail(self, node: CommentedMap, key: Any, message: str) -> NoReturn:
        """Raise InputError about the value of a key."""
        line, column = node.lc.key(key)
        raise InputError(f"{self._path}:{line + 1}:{column + 1}: {key}: {message}. {GUIDE}")

    def fail_at(self, line: int, column: int, message: str) -> NoReturn:
        """Raise InputError about a place, counted from 0."""
        raise InputError(f"{self._path}:{line + 1}:{column + 1}: {message}. {GUIDE}")

    def require_keys(self, node: CommentedMap, keys: Sequence[str], *, optional: Sequence[str] = ()) -> None:
        """Raise InputError unless a mapping has exactly these keys, and perhaps some optional ones."""
        for key in node:
            if key not in keys and key not in optional:
                self.fail(node, key, f"unknown key; the keys here are {', '.join((*keys, *optional))}")
        missing = [key for key in keys if key not in node]
        if missing:
            self.fail_at(node.lc.line, node.lc.col, f"{missing[0]} is missing, and cannot be guessed")


def _parsed(file: FilePart, place: _Place) -> CommentedMap:
    data = file.read_bytes()
    if len(data) > 1 << 20:
        raise InputError(f"{file.path}: too large for a calibration file ({len(data)} bytes). {GUIDE}")
    try:
        root = YAML(typ="rt", pure=True).load(data.decode("utf-8-sig"))
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place.fail_at(mark.line if mark else 0, mark.column if mark else 0, f"not valid YAML: {error.problem}")
    except (YAMLError, ValueError, RecursionError, TypeError, AttributeError, KeyError, AssertionError) as error:
        raise InputError(f"{file.path}: not a YAML file that can be read ({type(error).__name__}). {GUIDE}") from error
    if not isinstance(root, CommentedMap):
        raise InputError(f"{file.path}: must be a mapping with the keys model, first_pixel_px and lenses. {GUIDE}")
    return root


def _lens(node: CommentedMap, place: _Place, *, shift_px: float) -> tuple[FisheyeLens, Rigid3]:
    place.require_keys(node, _LENS_KEYS)
    width, height = _numbers(node, "image_size_px", place, count=2, what="width and height in pixels")
    fx, fy = _numbers(node, "focal_px", place, count=2, what="fx and fy in pixels")
    cx, cy = _numbers(node, "principal_point_px", place, count=2, what="cx and cy in pixels")
    k1, k2, k3, k4 = _numbers(node, "distortion", place, count=4, what="k1, k2, k3 and k4")
    field = node["field_of_view_deg"]
    if not _is_number(field) or not 0 < field <= 360:
        place.fail(node, "field_of_view_deg", "must be the full angle of the image circle, such as 195")
    if width != int(width) or height != int(height) or min(width, height) < 1:
        place.fail(node, "image_size_px", "must be two whole numbers of pixels: width, height")
    if min(fx, fy) <= 0:
        place.fail(node, "focal_px", "must be positive")
    if not (0 <= cx <= width and 0 <= cy <= height):
        place.fail(node, "principal_point_px", f"is outside of the picture of {int(width)}×{int(height)} pixels")
    try:
        lens = FisheyeLens(
            (int(height), int(width)),
            (fx, fy),
            (cx + shift_px, cy + shift_px),
            (k1, k2, k3, k4),
            float(np.radians(field / 2)),
        )
    except UsageError as error:
        place.fail(node, "distortion", f"{error}. Check the numbers, or state a smaller field_of_view_deg")
    return lens, _pose(node, place)


def _pose(node: CommentedMap, place: _Place) -> Rigid3:
    given = node["lens_from_rig"]
    if not isinstance(given, CommentedMap):
        place.fail(node, "lens_from_rig", "must have the keys rotation_wxyz or rotation, and translation_m")
    turn = "rotation" if "rotation" in given else "rotation_wxyz"
    place.require_keys(given, (turn, "translation_m"))
    translation = np.array(_numbers(given, "translation_m", place, count=3, what="x, y and z in metres"))
    if np.linalg.norm(translation) > 10:
        place.fail(given, "translation_m", "is more than 10 metres. Is it in millimetres?")
    if turn == "rotation_wxyz":
        quaternion = np.array(_numbers(given, turn, place, count=4, what="a quaternion w, x, y, z"))
        if abs(np.linalg.norm(quaternion) - 1) > _MAX_TURN_ERROR:
            place.fail(given, turn, "the length of the quaternion is not 1")
        return Rigid3(rotation_from_quat_wxyz(quaternion / np.linalg.norm(quaternion)), translation)
    rows = given["rotation"]
    fits = isinstance(rows, CommentedSeq) and len(rows) == 3
    if not fits or not all(
        isinstance(row, CommentedSeq) and len(row) == 3 and all(map(_is_number, row)) for row in rows
    ):
        place.fail(given, "rotation", "must be three rows of three numbers")
    matrix = np.array([[float(value) for value in row] for row in rows])
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _MAX_TURN_ERROR or np.linalg.det(matrix) < 0:
        place.fail(given, "rotation", "is not a rotation matrix: its rows must be orthonormal, its determinant 1")
    return Rigid3(nearest_rotation(matrix), translation)


def _numbers(node: CommentedMap, key: str, place: _Place, *, count: int, what: str) -> list[float]:
    values = node[key]
    if not isinstance(values, CommentedSeq) or len(values) != count or not all(map(_is_number, values)):
        place.fail(node, key, f"must be a list of {count} numbers: {what}")
    return [float(value) for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
