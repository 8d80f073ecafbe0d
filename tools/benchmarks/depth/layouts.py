"""Compare the ranges of a run with the drawn layouts of a real tour.

TOUR is a folder of the Zillow Indoor Dataset, such as sample_tour/000 of github.com/zillow/zind, and OUT the output of
a run on its panoramas. A layout is the outline of a room with its ceiling, in heights of the camera above the floor.
Rays that leave the room, through doors, windows and openings with their frames, are left out; furniture is not drawn.

Two scales are compared. In the first column, the median of the distances of cameras gives the scale of a group, so that
errors of the poses count. In the second, each view is scaled by the median height of its camera above the floor that it
confirms, which shows the shape of the rooms alone.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

import pano_mvs
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_solid_angle, ray_grid
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tools.benchmarks.table import print_table

FLOOR, WALL, CEILING, OPENING = range(4)
# The width of a frame around an opening, in heights of the camera.
_FRAME = 0.1
# Pixels from which the height of a camera is taken.
_LEAST_FLOOR = 500


def layout_ranges(panorama: dict[str, Any], size_hw: tuple[int, int]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the ranges of a room (H, W) in heights of the camera, and which surface each pixel shows."""
    layout = panorama.get("layout_visible") or panorama["layout_raw"]
    rays = ray_grid(size_hw)
    up, level = -rays[..., 1], np.hypot(rays[..., 0], rays[..., 2])
    across = np.stack([-rays[0, :, 0], rays[0, :, 2]], axis=1) / level[0, :, None]
    corners = np.array(layout["vertices"])
    wall = np.min([_hit(across, *edge) for edge in zip(corners, np.roll(corners, -1, axis=0), strict=True)], axis=0)
    height = panorama["ceiling_height"] - panorama["camera_height"]
    with np.errstate(divide="ignore"):
        surfaces = np.stack([np.where(up < 0, -1 / up, np.inf), wall / level, np.where(up > 0, height / up, np.inf)])
    kind = np.argmin(surfaces, axis=0)
    for holes in (layout["doors"], layout["windows"], layout["openings"]):
        for start, end, (low, high) in zip(holes[::3], holes[1::3], holes[2::3], strict=True):
            frame = _FRAME * (np.array(end) - start) / max(np.linalg.norm(np.array(end) - start), 1e-9)
            inside = (kind == WALL) & (_hit(across, start - frame, end + frame) < 1.3 * wall)
            at = wall * up / level
            kind[inside & (at >= low - _FRAME) & (at <= high + _FRAME)] = OPENING
    return surfaces.min(axis=0), kind


def _hit(across: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the distances along level directions (W, 2) at which they meet an edge, infinite if they do not."""
    edge = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = across[:, 0] * edge[1] - across[:, 1] * edge[0]
        distance = (start[0] * edge[1] - start[1] * edge[0]) / slope
        share = (start[0] * across[:, 1] - start[1] * across[:, 0]) / slope
    return np.where((distance > 0) & (share >= 0) & (share <= 1), distance, np.inf)


def measure(tour: Path, out: Path) -> dict[str, tuple[float, float]]:
    """Return shares of the solid angle at both scales, in the mean of all views that share a group with others."""
    known = json.loads((tour / "zind_data.json").read_text(encoding="utf-8"))
    panoramas = {
        Path(one["image_path"]).name: one
        for rooms in known["merger"].values()
        for parts in rooms.values()
        for part in parts.values()
        for one in part.values()
    }
    run = pano_mvs.load(out)
    if run.poses is None:
        raise SystemExit(f"{out}: contains no poses")
    rows = []
    for group in split_groups(run.poses):
        if len(group.names) < 2:
            continue
        places = [panoramas[name]["floor_plan_transformation"] for name in group.names]
        drawn, placed = (
            pdist(centers) for centers in (np.array([one["translation"] for one in places]), group.centers[:, [0, 2]])
        )
        unit = float(np.median(drawn / placed))
        for name, place in zip(group.names, places, strict=True):
            view = run.views[name]
            if view.range_map is not None and view.confidence is not None:
                rows.append(view_shares(panoramas[name], view.range_map * unit / place["scale"], view.confidence))
    return {
        key: (float(np.nanmean([row[key][0] for row in rows])), float(np.nanmean([row[key][1] for row in rows])))
        for key in rows[0]
    }


def view_shares(
    panorama: dict[str, Any], ranges: FloatArray, confidence: NDArray[np.uint8]
) -> dict[str, tuple[float, float]]:
    """Return the shares of one view as it is, and scaled by the height of its camera; NaN if it confirms no floor."""
    truth, kind = layout_ranges(panorama, (ranges.shape[0], ranges.shape[1]))
    sure = (kind == FLOOR) & (confidence >= CONSISTENT_CONFIDENCE[0])
    floor = ranges[sure] / truth[sure]
    height = float(np.median(floor)) if len(floor) >= _LEAST_FLOOR else np.nan
    one, other = (_shares(scaled, truth, confidence, kind=kind) for scaled in (ranges, ranges / height))
    return {key: (one[key], other[key] if np.isfinite(height) else np.nan) for key in one}


def _shares(
    ranges: FloatArray, truth: FloatArray, confidence: NDArray[np.uint8], *, kind: NDArray[np.int64]
) -> dict[str, float]:
    size = ranges.shape[0], ranges.shape[1]
    depth = ray_grid(size)[..., 1]
    error = np.abs(ranges / truth - 1)
    area = np.broadcast_to(pixel_solid_angle(size)[:, None], size)

    def share(of: NDArray[np.bool_], which: NDArray[np.bool_]) -> float:
        return float(area[of & which].sum() / area[of].sum()) if of.any() else np.nan

    steep = (depth > np.sin(np.radians(35))) & (depth < np.sin(np.radians(70)))
    confirmed = confidence >= CONSISTENT_CONFIDENCE[0]
    return {
        "10 % below the floor": share(steep, ranges * depth > 1.1),
        "steep floor within 2 %": share(steep & (kind == FLOOR), error < 0.02),
        "floor within 5 %": share(kind == FLOOR, error < 0.05),
        "walls within 5 %": share(kind == WALL, error < 0.05),
        "ceilings within 5 %": share(kind == CEILING, error < 0.05),
        "confirmed": share(kind != OPENING, confirmed),
        "confirmed, within 5 %": share(confirmed & (kind != OPENING), error < 0.05),
        "confirmed, within 10 %": share(confirmed & (kind != OPENING), error < 0.1),
    }


def main() -> None:
    """Print the shares for the run that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tour", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    rows = measure(given.tour, given.out).items()
    print_table(
        ["share, %", "as it is", "in heights of the camera"],
        ((key, *(f"{100 * share:.1f}" for share in both)) for key, both in rows),
    )
