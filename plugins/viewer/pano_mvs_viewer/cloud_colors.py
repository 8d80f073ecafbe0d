"""Select the points of a cloud to draw, and colour them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.io.ply import PlyPoints

POINT_BUDGET = 2_000_000
COLORINGS = ("rgb", "confidence", "views", "normals", "height")

_COLORS, _NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")
_NEEDED = {"rgb": (), "confidence": ("confidence",), "views": ("views",), "normals": _NORMALS, "height": ()}


@dataclass(frozen=True, eq=False)
class DrawnCloud:
    """The points that are drawn."""

    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    vertices: NDArray[np.void]
    total: int

    @property
    def colorings(self) -> tuple[str, ...]:
        """Available colourings of these points."""
        known = self.vertices.dtype.names or ()
        return tuple(name for name in COLORINGS if set(_NEEDED[name]) <= set(known))


@dataclass(frozen=True, eq=False)
class Coloring:
    """The colours of points."""

    colors_rgb: NDArray[np.uint8]
    legend: str


def drawn_cloud(cloud: PlyPoints, *, budget: int = POINT_BUDGET) -> DrawnCloud:
    """Return at most `budget` points of a cloud, 0 for all; only these are read from disk.

    One point is drawn at random from each section of the file. Regular steps would leave patterns,
    since neighbours in the file are neighbours in an image. The same file gives the same points.
    """
    count = len(cloud.vertices)
    chosen: NDArray[np.intp] | slice = slice(None)
    if budget and count > budget:
        jitter = np.random.default_rng(0).random(budget)
        chosen = np.minimum(((np.arange(budget) + jitter) * (count / budget)).astype(np.intp), count - 1)
    vertices = np.array(cloud.vertices[chosen])
    points = cloud.in_world(np.stack([vertices[name].astype(np.float32) for name in "xyz"], axis=-1))
    finite = np.isfinite(points).all(axis=-1)
    vertices, points = vertices[finite], points[finite]
    normals = None
    if set(_NORMALS) <= set(vertices.dtype.names or ()):
        in_file = np.stack([vertices[name].astype(np.float32) for name in _NORMALS], axis=-1)
        normals = cloud.in_world(np.nan_to_num(in_file))
    return DrawnCloud(points, normals, vertices, count)


def color_cloud(cloud: DrawnCloud, by: str, *, up: NDArray[np.float64], unit: str) -> Coloring:
    """Return the colours of a cloud.

    Raises:
        UsageError: if the file lacks the required properties.
    """
    if by not in cloud.colorings:
        raise UsageError(
            f"this cloud cannot be coloured by {by!r}, only by {', '.join(cloud.colorings)}: views and "
            "confidence are in clouds that export.ply writes with `quality: true`"
        )
    if by == "normals" and cloud.normals is not None:
        colors = np.rint((cloud.normals * [1, -1, -1] + 1) * 127.5).clip(0, 255).astype(np.uint8)
        return Coloring(colors, "normals: red to the right, green up, blue towards the viewer")
    if by == "height":
        heights = cloud.points @ up.astype(np.float32)
        low, high = np.quantile(heights, [0.02, 0.98]) if len(heights) else (0.0, 1.0)
        return Coloring(_mapped(heights, low, high), f"height: blue {low:z.3g} to red {high:z.3g} {unit}")
    if by == "rgb":
        if not set(_COLORS) <= set(cloud.vertices.dtype.names or ()):
            return Coloring(np.full((len(cloud.points), 3), 200, np.uint8), "this cloud has no colours")
        stacked = np.stack([cloud.vertices[name] for name in _COLORS], axis=-1)
        # Some programs write colours from 0 to 1.
        scaled = stacked * 255.0 if stacked.dtype.kind == "f" and stacked.max(initial=0) <= 1 else stacked
        return Coloring(np.clip(scaled, 0, 255).astype(np.uint8), "")
    values = cloud.vertices[by].astype(np.float32)
    high = 255.0 if by == "confidence" else max(float(values.max(initial=0)), 2.0)
    legend = (
        "confidence: blue 0 to red 255, consistent from 128"
        if by == "confidence"
        else (f"views that agree: blue 0 to red {high:.0f}")
    )
    return Coloring(_mapped(values, 0.0, high), legend)


def _mapped(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """Return colours from blue to red, (N, 3)."""
    share = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
    # The ends of the map are nearly black: its middle keeps its hue.
    levels = np.rint((0.06 + 0.88 * share) * 255).astype(np.uint8)
    if not len(levels):
        return np.zeros((0, 3), np.uint8)
    mapped = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return np.ascontiguousarray(mapped)
