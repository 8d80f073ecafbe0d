"""Fit and check how a capture that is upside down is found.

Run it with `python -m tools benchmarks poses.upside_down IMAGES=OUT … --cache DIR`: folders of images, and the output
folders of runs whose poses are level and upright. For each capture, the table shows the three differences of its
largest group (`differences_below`) and the probability that it is upside down, as it is and turned around, by
coefficients that are fitted to the other captures. Below are the coefficients for all: the scales are medians of the
sizes, the weights those of independent normal variables with opposite means for upright and turned captures.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pano_mvs
from pano_mvs.algorithms.poses.frame.upside_down import PRIOR_LOG_ODDS, differences_below
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.pose_groups import split_groups


def differences(images: Path, out: Path, cache: Path) -> FloatArray:
    """Return the differences (3,) of the largest group of a run."""
    poses = pano_mvs.load(out, cache=cache).poses
    assert poses is not None
    group = split_groups(poses)[0]
    pictures = {name: partial(_picture, images / name) for name in group.names}
    (found,) = differences_below(group, pictures, np.array([[0.0, -1.0, 0.0]]))
    return np.asarray(found)


def fitted(captures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the scales (3,) and the weights (3,) from the differences of upright captures (N, 3).

    One more capture counts that is the opposite of the mean: nothing is known about what N captures do not show.
    """
    scales = np.median(np.abs(captures), axis=0)
    bounded = np.tanh(captures / scales)
    bounded = np.vstack([bounded, -bounded.mean(axis=0)])
    return scales, -2 * bounded.mean(axis=0) / bounded.var(axis=0, ddof=1)


def _picture(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    image = decode_image(path)
    return image, np.ones(image.shape[:2], np.bool_)


def main() -> None:
    """Print the table and the coefficients."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="IMAGES=OUT")
    parser.add_argument("--cache", type=Path, required=True)
    given = parser.parse_args()
    folders = [tuple(map(Path, run.split("="))) for run in given.runs]
    known = np.array([differences(images, out, given.cache) for images, out in folders])
    print("| capture | light | texture | floor | p upright | p turned around |\n|---|---|---|---|---|---|")
    for number, (_, out) in enumerate(folders):
        scales, weights = fitted(np.delete(known, number, axis=0))
        evidence = float(np.tanh(known[number] / scales) @ weights)
        chances = [1 / (1 + np.exp(-(sign * evidence + PRIOR_LOG_ODDS))) for sign in (1, -1)]
        cells = " | ".join(f"{value:.2f}" for value in known[number])
        print(f"| {out.name} | {cells} | {chances[0]:.1e} | {chances[1]:.4f} |")
    scales, weights = fitted(known)
    print(f"scales {scales.round(2).tolist()}, weights {weights.round(1).tolist()}")
