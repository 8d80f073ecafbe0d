"""Images of the errors of a cloud: in the views, from above, from outside and from inside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import draw_cloud, viewpoints
from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.io.ply import RGB, ply_header
from pano_mvs_evaluation.clouds.distances import Points, PointsInMemory
from pano_mvs_evaluation.clouds.evaluate import CloudEvaluation
from pano_mvs_evaluation.drawing import WIDTH, drawn_figure

_VERTEX = np.dtype([*((name, "<f4") for name in "xyz"), *((name, "u1") for name in RGB), ("distance", "<f4")])
# From correct to wrong, distinguishable for colour-blind readers.
_NEAREST, _FARTHEST, _BEYOND = np.array([38, 130, 142]), np.array([240, 190, 60]), (190, 30, 45)


def distance_colors(distances: NDArray[np.float32], limits: Sequence[float]) -> NDArray[np.uint8]:
    """Return the colour, (..., 3) uint8 RGB, of each distance (...,).

    Distances within the smallest limit are dark, those within the largest light, and larger ones red; NaN is grey.
    """
    shares = np.linspace(0, 1, len(limits))[:, None]
    table = np.vstack([(1 - shares) * _NEAREST + shares * _FARTHEST, _BEYOND]).astype(np.uint8)
    level = np.searchsorted(np.asarray(limits, np.float32), distances.clip(0, np.float32(3e38)))
    colors = table[level.clip(0, len(limits))]
    colors[np.isnan(distances)] = 205
    return np.asarray(colors)


def write_error_cloud(
    path: Path,
    points: Iterable[NDArray[np.float32]],
    distances: NDArray[np.float32],
    *,
    limits: Sequence[float],
    farthest: float,
) -> None:
    """Write points as binary little-endian PLY: x y z, red green blue, and their distance as a scalar (float).

    Args:
        points: the points in chunks (K, 3), N in all, one chunk in memory at a time.
        distances: (N,) of each; larger ones than `farthest` are written as `farthest`.
        limits: tolerances in rising order, for the colours (see `distance_colors`).
        farthest: the largest distance that was measured.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    start = 0
    with path.open("wb") as stream:
        stream.write(ply_header(len(distances), _VERTEX))
        for chunk in points:
            part = distances[start : start + len(chunk)]
            start += len(chunk)
            vertices = np.zeros(len(part), _VERTEX)
            columns = (*chunk[: len(part)].T, *distance_colors(part, limits).T)
            for name, column in zip((*"xyz", *RGB), columns, strict=True):
                vertices[name] = column
            vertices["distance"] = np.minimum(part, np.float32(farthest))
            stream.write(vertices.tobytes())
    if start != len(distances):
        raise UsageError(f"{start} points, but {len(distances)} distances")


_MAX_POINTS = 2_000_000
_LEGEND_COLUMNS = 7
_SIZE_HW = 640, WIDTH


def write_error_clouds(folder: Path, evaluation: CloudEvaluation) -> None:
    """Write accuracy.ply and completeness.ply, a picture of each, and errors.png (see `write_overview`).

    Both clouds lie in the truth's frame: the points of the cloud coloured by their distance from the true surface, and
    the surface that should be covered coloured by its distance from the cloud.
    """
    surface, distances = evaluation.compared.surface, evaluation.distances
    limits, farthest = evaluation.limits, evaluation.farthest
    write_error_cloud(
        folder / "accuracy.ply", evaluation.cloud.chunks(), distances.of_points, limits=limits, farthest=farthest
    )
    samples = PointsInMemory(surface.points_in_world).chunks()
    write_error_cloud(folder / "completeness.ply", samples, distances.of_surface, limits=limits, farthest=farthest)
    title = "cloud by its distance from the true surface"
    _write_views(folder / "accuracy.png", _some_points(evaluation), title=title, evaluation=evaluation)
    step = -(-len(surface.points_in_world) // _MAX_POINTS) or 1
    points = surface.points_in_world[::step]
    normals, title = _towards_cameras(evaluation, step), "true surface by its distance from the cloud"
    some = distances.of_surface[::step]
    _write_views(folder / "completeness.png", (points, normals, some), title=title, evaluation=evaluation)
    write_overview(folder / "errors.png", evaluation)


def write_overview(path: Path, evaluation: CloudEvaluation) -> None:
    """Write a PNG of the surface's distances from the cloud in each view, and of the cloud's distances from above.

    Of many views, those are shown in which most of the surface was missed.
    """
    surface, distances, limits = evaluation.compared.surface, evaluation.distances, evaluation.limits
    missed = surface.area * (distances.of_surface > limits[-1])
    lost = np.bincount(surface.view_idx, missed, max(1, len(evaluation.compared.used)))
    shown = set(np.argsort(-lost, kind="stable")[:12].tolist())
    shown_pictures: list[tuple[str, Picture]] = []
    for idx, (name, view) in enumerate(evaluation.compared.used.items()):
        if idx not in shown:
            continue
        own = surface.view_idx == idx
        panorama = np.full(view.range.shape, np.nan, np.float32)
        panorama.reshape(-1)[surface.pixel_idx[own]] = distances.of_surface[own]
        rows = np.unique(np.nonzero(~np.isnan(panorama))[0])
        step = int(np.diff(rows).min()) if len(rows) > 1 else 1  # between rows with samples
        colors = distance_colors(panorama[step // 2 :: step, step // 2 :: step], limits)
        shown_pictures.append((f"{name}: true surface, by its distance from the cloud", colors))
    points, _, of_points = _some_points(evaluation)
    if len(points):
        title = "cloud from above, by its distance from the true surface"
        shown_pictures.append((title, _top_view(points, of_points, limits)))
    _write_pictures(path, shown_pictures, limits)


def _write_views(path: Path, cloud: tuple[Points, Points, Points], *, title: str, evaluation: CloudEvaluation) -> None:
    """Write a PNG of points coloured by their distances, seen from three places, with a legend."""
    points, normals, distances = cloud
    pictures: list[tuple[str, Picture]] = []
    if len(points):
        cameras, up = evaluation.compared.cameras, evaluation.compared.up
        colors = distance_colors(distances, evaluation.limits)
        for view in viewpoints(points, cameras, up, aspect=_SIZE_HW[1] / _SIZE_HW[0]):
            drawn = draw_cloud(points, normals, colors, viewpoint=view, size_hw=_SIZE_HW)
            pictures.append((f"{title}, {view.title.lower()}", drawn))
    _write_pictures(path, pictures, evaluation.limits)


def _write_pictures(path: Path, pictures: Sequence[tuple[str, Picture]], limits: Sequence[float]) -> None:
    """Write a PNG of pictures with titles below each other, and of what the colours of `distance_colors` mean."""
    from matplotlib.patches import Patch

    heights = [WIDTH * len(picture) / picture.shape[1] for _, picture in pictures]
    entries = [(limit, f"up to {limit:g}") for limit in limits] + [(np.inf, "farther"), (np.nan, "not counted")]
    colors = distance_colors(np.array([distance for distance, _ in entries], np.float32), limits) / 255
    patches = [Patch(color=color, label=text) for color, (_, text) in zip(colors, entries, strict=True)]
    legend = 40 + 20 * -(-len(patches) // _LEGEND_COLUMNS)
    with drawn_figure(path, (WIDTH, sum(heights) + 40 * len(pictures) + legend)) as figure:
        figure.legend(handles=patches, loc="outside upper left", ncols=_LEGEND_COLUMNS, frameon=False)
        grid = figure.add_gridspec(max(len(pictures), 1), 1, height_ratios=heights or None)
        for row, (title, picture) in enumerate(pictures):
            axes = figure.add_subplot(grid[row, 0])
            axes.imshow(picture, interpolation="nearest")
            axes.set_title(title, loc="left", parse_math=False)
            axes.set_axis_off()


def _some_points(evaluation: CloudEvaluation) -> tuple[Points, Points, Points]:
    """Return positions and normals (0 if unknown) in the truth's frame, and distances, of at most `_MAX_POINTS`."""
    step = -(-evaluation.cloud.count // _MAX_POINTS) or 1
    return *evaluation.cloud.some(step), evaluation.distances.of_points[::step]


def _towards_cameras(evaluation: CloudEvaluation, step: int) -> Points:
    """Return unit vectors (N, 3) from samples of the surface to the cameras that saw them; 0 for a reference cloud."""
    surface, used = evaluation.compared.surface, evaluation.compared.used
    points = surface.points_in_world[::step]
    if not used:
        return np.zeros_like(points)
    centers = np.array([view.cam_from_world.center for view in used.values()])
    towards = centers[surface.view_idx[::step]] - points
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True), np.float32)


def _top_view(points: Points, distances: Points, limits: Sequence[float]) -> Picture:
    """Return the cloud from above without its outermost 1 %; of the points of a pixel, the worst is shown."""
    flat = points[:, [0, 2]].astype(np.float64)
    low, high = np.quantile(flat, [0.005, 0.995], axis=0)
    scale = (WIDTH - 1) / max(float((high - low).max()), 1e-9)
    size = np.minimum(np.ceil((high - low) * scale).astype(int) + 1, WIDTH)  # the product may round above WIDTH - 1
    pixel = np.rint((flat - low) * scale).astype(int)
    inside = ((pixel >= 0) & (pixel < size)).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(distances[inside], kind="stable")]
    view = np.full((size[1], WIDTH, 3), 255, np.uint8)
    # z points ahead, which is upwards in the picture.
    view[size[1] - 1 - pixel[order, 1], pixel[order, 0]] = distance_colors(distances[order], limits)
    return view
