"""What it costs to take a rig of two lenses as a central camera, and what its known offsets give.

Run it with `python -m tools benchmarks poses.rig_offsets`. Synthetic observations of the furnished room are refined
with and without the rays of the lenses (`tests.algorithms.poses.rig_capture`).
"""

from __future__ import annotations

import argparse

import numpy as np

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from tests.algorithms.poses.rig_capture import rig_capture


def main() -> None:
    """Print the table of docs/rigs.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="captures per row")
    parser.add_argument("--noise-deg", type=float, default=0.03, help="noise of the rays")
    args = parser.parse_args()
    print("D, offset mm, share of the baseline: central mm and °, with offsets mm and °, unit %, captures in metres")
    for distance in (3.0, np.inf):
        for offset_m in (0.01, 0.02, 0.03, 0.06, 0.1):
            row(distance, offset_m, seeds=args.seeds, noise_deg=args.noise_deg)


def row(distance: float, offset_m: float, *, seeds: int, noise_deg: float) -> None:
    """Print the medians over some captures."""
    central, known, units, baselines = [], [], [], []
    for seed in range(seeds):
        capture = rig_capture(offset_m=offset_m, stitch_distance_m=distance, noise_deg=noise_deg, seed=seed)
        refined = refine_poses(capture.poses, rigs=capture.rigs)
        central.append(capture.errors(refine_poses(capture.poses)))
        known.append(capture.errors(refined))
        if refined.metric:
            units.append(100 * capture.scale_error(refined))
        centers = np.array([pose.center for pose in capture.true])
        baselines.append(np.median(np.linalg.norm(centers[1:] - centers[0], axis=1)))
    worse, better = np.median(central, axis=0), np.median(known, axis=0)
    print(
        f"{distance:g} {1000 * offset_m:4.0f} {offset_m / np.median(baselines):6.3f}: "
        f"{1000 * worse[0]:6.2f} {worse[1]:6.3f}, {1000 * better[0]:5.2f} {better[1]:6.4f}, "
        f"{np.median(units) if units else np.nan:5.2f}, {len(units)} of {seeds}"
    )
