"""Are standard deviations of ranges what they claim to be.

Runs the dense stages of a workflow (`--workflow`, default quality) with true poses on synthetic scenes and on rendered
captures with truth, and prints for each place the share of confirmed pixels whose error is within one, two and three
standard deviations (68, 95 and 99.7 % for a normal distribution), weighted by solid angle, the median standard
deviation, and how the median error grows with it. Poses are true, so that only matching is measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tests.synthetic.scenes import SCENES
from tools.benchmarks.captures import SCRATCH, Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, Overrides
from tools.benchmarks.table import print_table

_EDGE = 1.1


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


def row(chain: DenseChain, capture: Capture, *, references: int) -> list[object]:
    """Return one row of the table."""
    run = chain.run(capture)
    checked = next(
        maps for maps in run.range_maps.values() if all(item.uncertainty is not None for item in maps.values())
    )
    parts = [confirmed_errors(checked[name], capture.ranges[name]) for name in list(capture.ranges)[:references]]
    error, sigma, area = (np.concatenate(part) for part in zip(*parts, strict=True))
    limits = np.quantile(sigma, [0.25, 0.5, 0.75])
    quarters = [np.median(error[np.digitize(sigma, limits) == quarter]) for quarter in range(4)]
    shares = [f"{100 * share:.1f}" for share in coverage(error, sigma, area)]
    medians = " ".join(f"{100 * value:.2f}" for value in quarters)
    return [capture.name, len(error), *shares, f"{100 * np.median(sigma):.2f}", medians]


def captures(data: Sequence[Path], scenes: Sequence[str], views: int) -> Iterator[Capture]:
    """Yield captures with truth at half their size, and synthetic scenes."""
    for folder in data:
        full = read_capture(folder).first(views)
        half = read_capture(folder, width=next(iter(full.ranges.values())).shape[1] // 2).first(views)
        yield replace(half, ranges={name: halved_truth(truth) for name, truth in full.ranges.items()})
    for name in scenes:
        yield scene_capture(SCENES[name](seed=0, exposure=0.0), SCRATCH / f"{name}-512", width=512)


def main(
    workflow: str = "quality",
    data: list[Path] | None = None,
    scene: list[str] | None = None,
    views: int = 5,
    references: int = 3,
    overrides: Overrides = None,
) -> None:
    """Print the table.

    Args:
        workflow: preset or file.
        data: captures with truth.
        scene: synthetic scenes; default all.
        views: number of views of a capture.
        references: number of views that are scored.
        overrides: as `--set` of `run`.
    """
    cv2.setNumThreads(1)
    chain = DenseChain(workflow, overrides=overrides or ())
    columns = ("place", "pixels", "within 1 σ %", "2 σ %", "3 σ %", "median σ %", "median error % by quarter of σ")
    places = captures(data or (), scene or list(SCENES), views)
    print_table(columns, (row(chain, capture, references=references) for capture in places))
