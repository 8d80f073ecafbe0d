"""Floor plans of rendered places with true poses, compared with the true walls.

Each DIR is a house that `poses.tours.houses` wrote, named as there, or a rendered capture with true ranges. The dense
stages of a workflow are run with the true poses, and `export.floor_plan` on what they made. Their results are stored,
so that another run measures a change of the plan alone.

* found: share of the length of the true walls, with windows, that a drawn wall or window covers, within 5 cm and 5°;
* error: median and 90 % of the distances of what is drawn within 30 cm of a true wall;
* false: share of the drawn length without a true wall within 30 cm and 5°;
* rooms: those whose drawn outline overlaps with the true one by 90 %, of all that have a camera, and the median error
  of their areas;
* doors: openings of the true plan that are drawn, within 30 cm, of all, and how many others are drawn, at no door or
  glass door within 60 cm;
* windows: the same of windows;
* sizes: median and 95 % of the errors of length and width of the rooms that are found, and the share within twice
  their stated standard deviations; heights: the same of the heights of these rooms;
* levels: median and 95 % of the errors of tops of openings and bottoms of windows; widths: the same of the widths of
  openings, of which doors have frames of 5 cm on each side;
* leaves: open leaves of the doors that are drawn whose free ends are drawn within 30 cm, of all, and how many others.

The walls of a house are those of the rooms in which a camera stands. Those of a capture are the places where its true
ranges show vertical surfaces at 40 % of the height of the storey; their angle is not compared.
"""

from __future__ import annotations

import argparse
import json
import pickle
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pano_mvs_floor_plan.stages import FloorPlanParams, floor_plan
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import ray_grid
from pano_mvs.scene import Files, PointCloud, RangeMap
from pano_mvs.scene.surfaces import Structure
from tools.benchmarks.captures import SCRATCH, Capture, read_capture
from tools.benchmarks.dense_chain import DenseChain, context, true_poses, with_true_points
from tools.benchmarks.depth.houses import read_house
from tools.benchmarks.poses.tours.houses import HOUSES
from tools.benchmarks.poses.tours.plan import WALL, rooms_of
from tools.benchmarks.table import print_table

_STEP, _FOUND, _NEAR, _FALSE = 0.01, 0.05, 0.30, np.cos(np.radians(5.0))


@dataclass(frozen=True, eq=False)
class Samples:
    """Points on lines of a plan, every centimetre: positions and directions (N, 2)."""

    xy: FloatArray
    along: FloatArray

    @staticmethod
    def of(segments: Sequence[FloatArray]) -> Samples:
        """Return samples of segments (2, 2)."""
        xy, along = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for start, end in segments:
            length = float(np.linalg.norm(end - start))
            steps = (np.arange(round(length / _STEP)) + 0.5) * _STEP
            xy.append(start + steps[:, None] * (end - start) / max(length, 1e-9))
            along.append(np.broadcast_to((end - start) / max(length, 1e-9), (len(steps), 2)))
        return Samples(np.concatenate(xy), np.concatenate(along))

    def distances(self, others: Samples, *, within: float, parallel: bool = True) -> FloatArray:
        """Return the distance of each to the nearest parallel one of others, infinite if none is near."""
        found = np.full(len(self.xy), np.inf)
        if not len(others.xy):
            return found
        for number, indices in enumerate(cKDTree(others.xy).query_ball_point(self.xy, within)):
            near = np.array(indices, np.intp)
            if parallel:
                near = near[np.abs(others.along[near] @ self.along[number]) > _FALSE]
            if len(near):
                offset = others.xy[near] - self.xy[number]
                if parallel:  # across; along it is the distance of the samples
                    offset = offset - (offset * others.along[near]).sum(axis=1, keepdims=True) * others.along[near]
                found[number] = np.linalg.norm(offset, axis=1).min()
        return found


@dataclass(frozen=True, eq=False)
class TrueStorey:
    """The true plan of one storey: walls and openings as samples, rooms as rectangles (x0, y0, x1, y1)."""

    floor: float
    walls: Samples
    rooms: list[tuple[float, float, float, float]]
    doors: list[FloatArray]  # (2, 2) ends, in the middle of the wall
    windows: list[FloatArray]
    height: float = np.nan
    leaf_ends: Sequence[tuple[float, float] | None] = ()  # of the doors
    levels: Sequence[tuple[float, float]] = ()  # of the doors and then of the windows, above the floor
    parallel: bool = True


def true_storeys(name: str) -> list[TrueStorey]:
    """Return the storeys of a house, the lowest first."""
    rooms, openings = rooms_of(HOUSES[name], seed=int(name.rpartition("_")[2]))
    result = []
    for floor in sorted({room.floor for room in rooms}):
        segments: list[FloatArray] = []
        rectangles = []
        own = [one for one in openings if one.floor == floor]
        doors = [one for one in own if one.kind in ("door", "opening")]
        for room in (one for one in rooms if one.floor == floor):
            x0, y0, x1, y1 = np.array(room.rectangle) + np.array([1, 1, -1, -1]) * WALL / 2
            rectangles.append((float(x0), float(y0), float(x1), float(y1)))
            for axis, line, start, end in ((0, y0, x0, x1), (0, y1, x0, x1), (1, x0, y0, y1), (1, x1, y0, y1)):
                gaps = sorted((one.start, one.end) for one in doors if one.axis == axis and abs(one.line - line) < WALL)
                edges = [start, *(edge for gap in gaps for edge in gap), end]
                for a, b in zip(edges[::2], edges[1::2], strict=True):
                    if b - a > _STEP and a < end and b > start:
                        ends = np.array([[a, line], [b, line]])
                        segments.append(ends if axis == 0 else ends[:, ::-1])
        middles = {
            kind: [
                np.array([[one.start, one.line], [one.end, one.line]])[:, :: 1 if one.axis == 0 else -1] for one in ones
            ]
            for kind, ones in (("doors", doors), ("windows", [one for one in own if one not in doors]))
        }
        height = next(room.height for room in rooms if room.floor == floor)
        leaf_ends = [one.leaf_end for one in doors]
        levels = [(one.bottom, one.top) for one in [*doors, *(one for one in own if one not in doors)]]
        walls = Samples.of(segments)
        result.append(
            TrueStorey(floor, walls, rectangles, middles["doors"], middles["windows"], height, leaf_ends, levels)
        )
    return result


def shown_storey(capture: Capture, storey: dict[str, Any], turn: FloatArray) -> TrueStorey:
    """Return what true ranges show of the walls of a storey that a plan states."""
    low, high = storey["z_range"]
    cells: set[tuple[int, int, int]] = set()
    for name, ranges in capture.ranges.items():
        pose = capture.poses[name]
        points = (pose.center + ray_grid(ranges.shape) @ pose.rotation * ranges[..., None]) @ turn.T
        across, down = np.diff(points, axis=1)[:-1], np.diff(points, axis=0)[:, :-1]
        normals = np.cross(across, down)
        upright = np.abs(normals[..., 2]) < 0.1 * np.linalg.norm(normals, axis=-1)
        share = (points[:-1, :-1, 2] - low) / (high - low)
        chosen = upright & (share > 0.05) & (share < 0.95)
        layers = (share[chosen] * 32).astype(int)
        columns = np.floor(points[:-1, :-1][chosen][:, :2] / (2 * _STEP)).astype(int)
        cells |= set(map(tuple, np.column_stack([columns, layers]).tolist()))
    columns, counts = np.unique(np.array(sorted(cells))[:, :2], axis=0, return_counts=True)
    xy = (columns[counts >= 0.4 * 32] + 0.5) * 2 * _STEP
    return TrueStorey(low, Samples(xy, np.zeros_like(xy)), [], [], [], parallel=False)


def compared(true: TrueStorey, walls: Samples, drawn: dict[str, Any]) -> dict[str, FloatArray]:
    """Return, for each figure, what it is a sum or a quantile of."""
    to_true = walls.distances(true.walls, within=_NEAR, parallel=true.parallel)
    from_true = true.walls.distances(walls, within=_FOUND, parallel=true.parallel)
    outlines = [np.array(room["outline"]) for room in drawn.get("rooms", [])]
    areas: list[float] = []
    sizes: list[tuple[float, float]] = []
    heights: list[tuple[float, float]] = []
    for x0, y0, x1, y1 in true.rooms:
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        best, number = max(((_overlap(corners, one), idx) for idx, one in enumerate(outlines)), default=(0.0, 0))
        if best > 0.9:
            areas.append(abs(best - 1))
            room = drawn["rooms"][number]
            lengths = sorted((x1 - x0, y1 - y0), reverse=True)
            sizes += [
                (found - true, std)
                for found, true, std in zip(room["size"], lengths, room["size_stds"], strict=True)
                if found is not None
            ]
            if room["height"] is not None:
                heights.append((room["height"] - true.height, room["height_std"]))
    openings = {}
    for kind, those in (("door", true.doors), ("window", true.windows)):
        # A glass door to a balcony may be drawn as either.
        every = [np.mean(one, axis=0) for one in ([*those, *true.windows] if kind == "door" else those)]
        found = [np.mean(one["ends"], axis=0) for one in drawn.get("openings", []) if one["kind"] == kind]
        hit = [any(np.linalg.norm(one - other) < _NEAR for other in found) for one in every[: len(those)]]
        wrong = [not any(np.linalg.norm(one - other) < 2 * _NEAR for other in every) for one in found]
        openings[f"{kind}s"] = np.array([sum(hit), len(those), sum(wrong)])
    return (
        {
            "found": np.isfinite(from_true),
            "errors": to_true[np.isfinite(to_true)],
            "false": ~np.isfinite(to_true),
            "rooms": np.array([len(areas), len(true.rooms)]),
            "areas": np.array(areas),
            "sizes": np.array(sizes, np.float64).reshape(-1, 2),
            "heights": np.array(heights, np.float64).reshape(-1, 2),
            "leaves": _leaves(true, drawn),
        }
        | openings
        | _opening_errors(true, drawn)
    )


def _opening_errors(true: TrueStorey, drawn: dict[str, Any]) -> dict[str, FloatArray]:
    """Return the errors of the tops of drawn openings and of the bottoms of windows, and of the widths of openings."""
    levels, widths = [], []
    ends = [*true.doors, *true.windows]
    middles = np.array([np.mean(one, axis=0) for one in ends]).reshape(-1, 2)
    for opening in drawn.get("openings", []) if true.levels else ():
        away = np.linalg.norm(middles - np.mean(opening["ends"], axis=0), axis=1)
        if len(away) and away.min() < _NEAR:
            nearest = int(away.argmin())
            bottom, top = true.levels[nearest]
            levels += [opening["top"] - top] + ([opening["bottom"] - bottom] if opening["kind"] == "window" else [])
            widths.append(
                float(np.linalg.norm(np.diff(opening["ends"], axis=0)) - np.linalg.norm(np.diff(ends[nearest], axis=0)))
            )
    return {"levels": np.array(levels, np.float64), "widths": np.array(widths, np.float64)}


def _leaves(true: TrueStorey, drawn: dict[str, Any]) -> NDArray[np.int64]:
    """Return how many leaves of drawn doors are drawn where they are, of how many, and how many are drawn elsewhere."""
    found = held = wrong = 0
    for opening in drawn.get("openings", []):
        near = [
            end
            for ends, end in zip(true.doors, true.leaf_ends, strict=False)
            if np.linalg.norm(np.mean(ends, axis=0) - np.mean(opening["ends"], axis=0)) < _NEAR
        ]
        leaf = opening["leaf"] and opening["leaf"]["open_end"]
        is_right = bool(leaf) and any(
            one is not None and np.linalg.norm(np.subtract(one, leaf)) < _NEAR for one in near
        )
        held += any(one is not None for one in near)
        found += is_right
        wrong += bool(leaf) and not is_right
    return np.array([found, held, wrong])


def _overlap(first: FloatArray, second: FloatArray) -> float:
    """Return the intersection of two outlines as a share of their union, on a grid of 2 cm."""
    low = np.minimum(first.min(axis=0), second.min(axis=0))
    size = np.ceil((np.maximum(first.max(axis=0), second.max(axis=0)) - low) / 0.02).astype(int) + 2
    masks = []
    for outline in (first, second):
        mask = np.zeros((size[1], size[0]), np.uint8)
        cv2.fillPoly(mask, [np.rint((outline - low) / 0.02).astype(np.int32)], 1)
        masks.append(mask > 0)
    return float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


@dataclass(frozen=True, eq=False)
class Dense:
    """What the dense stages made of a capture: the last range maps, and the cloud."""

    ranges: dict[str, RangeMap]
    planes: Structure | None
    cloud: PointCloud


def dense(chain: DenseChain, capture: Capture, *, width: int) -> Dense:
    """Return what the dense stages make of a capture, from a file if they have run before."""
    path = SCRATCH / "plans" / f"{capture.name}_{width}_{chain.key()}_points.pkl"
    if not path.is_file():
        run = chain.run(capture, poses=with_true_points(true_poses(capture), capture.ranges))
        made = Dense(list(run.range_maps.values())[-1], run.planes, chain.fused(capture, run))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(made))
    made = pickle.loads(path.read_bytes())
    assert isinstance(made, Dense)
    return made


def planned(capture: Capture, made: Dense, settings: dict[str, Any], *, folder: Path) -> Files:
    """Return the files of the floor plan, in a folder whose contents are replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    params = FloorPlanParams.model_validate({"formats": ("png", "svg")} | settings)
    return floor_plan(made.cloud, true_poses(capture), made.ranges, made.planes, params=params, ctx=context(folder))


def measured(capture: Capture, files: Files) -> dict[str, NDArray[Any]]:
    """Return what the plan of a capture is compared by, all storeys together."""
    about = json.loads(files.files["floor_plan/floor_plan.json"].read_text())
    rows = []
    true = true_storeys(capture.name) if capture.name in HOUSES else None
    for storey in about["storeys"]:
        drawn = [*storey["walls"], *(one for one in storey["openings"] if one["kind"] == "window")]
        walls = Samples.of([np.array(one["ends"]) for one in drawn])
        shown = (
            shown_storey(capture, storey, np.array(about["file_from_world"]))
            if true is None
            else min(true, key=lambda one: abs(one.floor - storey["z_range"][0]))
        )
        rows.append((shown, compared(shown, walls, storey)))
    for missing in [one for one in true or [] if not any(one is shown for shown, _ in rows)]:
        rows.append((missing, compared(missing, Samples.of([]), {})))
    return {
        key: np.sum(parts, axis=0) if key in ("rooms", "doors", "windows", "leaves") else np.concatenate(parts)
        for key in rows[0][1]
        if (parts := [row[key] for _, row in rows])
    }


def figures(found: dict[str, NDArray[Any]]) -> tuple[str, ...]:
    """Return the columns of the table."""
    median, most = np.quantile(found["errors"], [0.5, 0.9]) * 100 if len(found["errors"]) else (np.nan, np.nan)
    area = 100 * np.median(found["areas"]) if len(found["areas"]) else np.nan
    rooms = found["rooms"]
    return (
        f"{100 * found['found'].mean():.1f} %",
        f"{median:.1f} cm",
        f"{most:.1f} cm",
        f"{100 * found['false'].mean():.1f} %",
        f"{rooms[0]} of {rooms[1]}",
        f"{area:.1f} %",
        *("{} of {}, {} wrong".format(*found[kind]) for kind in ("doors", "windows", "leaves")),
        *(_errors_text(found[kind]) for kind in ("sizes", "heights")),
        *(
            "{:.0f}, {:.0f} cm".format(*np.quantile(np.abs(found[kind]), [0.5, 0.95]) * 100)
            if len(found[kind])
            else "–"
            for kind in ("levels", "widths")
        ),
    )


def _errors_text(errors: FloatArray) -> str:
    """Return the median and 95 % of errors with standard deviations (N, 2), and the share within two of these."""
    if not len(errors):
        return "–"
    size = np.abs(errors[:, 0])
    median, most = np.quantile(size, [0.5, 0.95]) * 100
    return f"{median:.1f}, {most:.1f} cm, {100 * np.mean(size <= 2 * errors[:, 1]):.0f} % of {len(errors)}"


def main() -> None:
    """Measure the places that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--set", action="append", default=[], metavar="PARAM=VALUE", help="of export.floor_plan")
    parser.add_argument("--width", type=int, default=512)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    chain = DenseChain(given.workflow)
    settings = dict(one.split("=", 1) for one in given.set)
    rows = []
    for folder in given.places:
        is_house = folder.resolve().name in HOUSES
        capture = read_house(folder, width=given.width).capture if is_house else read_capture(folder, width=given.width)
        made = dense(chain, capture, width=given.width)
        files = planned(capture, made, settings, folder=SCRATCH / "plans" / capture.name)
        rows.append((capture.name, *figures(measured(capture, files))))
    print_table(["place", "found", "error", "90 %", "false", "rooms", "area", "doors", "windows", "leaves", "sizes",
                 "heights", "levels", "widths"], rows)  # fmt: skip
