"""Are standard deviations of ranges what they claim to be: `python -m tests.benchmarks.uncertainty [--data DIR …]`.

Runs the dense stages of a workflow (`--workflow`, default quality) with true poses on synthetic scenes and on rendered
captures with truth, and prints for each place the share of confirmed pixels whose error is within one, two and three
standard deviations (68, 95 and 99.7 % for a normal distribution), weighted by solid angle, the median standard
deviation, and how the median error grows with it. Poses are true, so that only matching is measured.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.testing.scenes import SCENES
from tests.benchmarks.captures import Capture, read_capture, scene_captures
from tests.benchmarks.dense_chain import DenseChain

HEADER = (
    "| place | pixels | within 1 σ % | 2 σ % | 3 σ % | median σ % | median error % by quarter of σ |\n"
    + "|---" * 7
    + "|"
)
_EDGE = 1.1

FloatArray = NDArray[np.float64]


def confirmed_errors(range_map: RangeMap, truth: NDArray[np.float32]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the relative errors, standard deviations and solid angles of the confirmed pixels with truth."""
    assert range_map.uncertainty is not None
    known = (range_map.confidence >= CONSISTENT_CONFIDENCE[0]) & np.isfinite(truth)
    area = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)
    error = np.abs(range_map.range[known] / truth[known] - 1).astype(np.float64)
    return error, range_map.uncertainty[known].astype(np.float64), np.asarray(area[known], np.float64)


def coverage(error: FloatArray, sigma: FloatArray, area: FloatArray) -> list[float]:
    """Return the shares of errors within one, two and three standard deviations."""
    return [float(area[error < times * sigma].sum() / area.sum()) for times in (1, 2, 3)]


def halved_truth(truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return true ranges (H, W) at half the size: the mean of 1 / range on surfaces, one of four pixels at edges.

    The nearest pixel is a quarter of a pixel off, which on slanted surfaces is more than the error of a range.
    """
    height, width = truth.shape
    blocks = truth.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(height // 2, width // 2, 4)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = 1 / np.mean(1 / blocks.astype(np.float64), axis=-1)
        edge = ~(blocks.max(axis=-1) <= _EDGE * blocks.min(axis=-1))
    return np.where(edge, truth[1::2, 1::2], mean).astype(np.float32)


def line(chain: DenseChain, capture: Capture, *, references: int) -> str:
    """Return one row of the table."""
    run = chain.run(capture)
    checked = next(
        maps for maps in run.range_maps.values() if all(item.uncertainty is not None for item in maps.values())
    )
    parts = [confirmed_errors(checked[name], capture.ranges[name]) for name in list(capture.ranges)[:references]]
    error, sigma, area = (np.concatenate(part) for part in zip(*parts, strict=True))
    limits = np.quantile(sigma, [0.25, 0.5, 0.75])
    quarters = [np.median(error[np.digitize(sigma, limits) == quarter]) for quarter in range(4)]
    shares = " | ".join(f"{100 * share:.1f}" for share in coverage(error, sigma, area))
    medians = " ".join(f"{100 * value:.2f}" for value in quarters)
    return f"| {capture.name} | {len(error)} | {shares} | {100 * np.median(sigma):.2f} | {medians} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="quality", help="workflow or preset")
    parser.add_argument("--data", type=Path, action="append", default=[], help="a capture with truth; repeatable")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), help="synthetic scenes")
    parser.add_argument("--views", type=int, default=5, help="number of views of a capture")
    parser.add_argument("--references", type=int, default=3, help="number of views that are scored")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="STAGE.PARAM=VALUE")
    chosen = parser.parse_args(arguments)
    chain = DenseChain(chosen.workflow, overrides=chosen.overrides)
    print(HEADER)
    for folder in chosen.data:
        full = read_capture(folder).first(chosen.views)
        half = read_capture(folder, width=next(iter(full.ranges.values())).shape[1] // 2).first(chosen.views)
        ranges = {name: halved_truth(truth) for name, truth in full.ranges.items()}
        print(line(chain, Capture(half.name, half.panoramas, half.poses, ranges), references=chosen.references))
    with tempfile.TemporaryDirectory() as folder_name:
        for capture in scene_captures(Path(folder_name), names=chosen.scenes, width=512):
            print(line(chain, capture, references=chosen.references))


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
