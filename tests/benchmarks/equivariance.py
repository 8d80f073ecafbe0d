"""Does it matter where in the picture a thing is: `python -m tests.benchmarks.equivariance [--data DIR] [--set …]`.

Poses are given and turned with the pictures; what the dense stages of a workflow (`--workflow`, default quality) make
of them is compared stage by stage, so that the first stage that fails shows:

* roll: every picture rolled by its own number of columns, a quarter to three quarters of them. Median and share above
  1 % of the relative difference to the ranges as they were, rolled; bar: median ≤ 1e-3.
* turn: the reference alone turned arbitrarily. The same, sampled in between the pixels; bar: median ≤ 5e-3.
* seam: bad pixels (relative error above 5 %, or no range) in the outermost 4 columns on either side, against the same
  pixels in the rolled pictures, where they lie well inside; bar: ratio ≤ 1.2.
* poles: bad solid angle above 80° of latitude, against the same surfaces when all cameras are turned by a quarter
  about x, so that they come to lie at the equator; bar: ratio ≤ 1.2.

Left out: pixels within 2 of a jump of the truth by more than 5 %, and those that the stage gave no range in either.
Synthetic scenes are rendered afresh for every turn. A place's shares are those of all its views together.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import (
    pad_panorama,
    pixel_from_ray,
    pixel_solid_angle,
    ray_grid,
    rotation_from_quat_wxyz,
    rotation_from_rotvec,
    sample_panorama,
)
from pano_mvs.testing.scenes import SCENES
from tests.benchmarks.captures import Capture
from tests.benchmarks.dense_chain import DenseChain, DenseRun
from tests.benchmarks.turned import FolderPlace, Place, ScenePlace, rolled

Ranges = NDArray[np.float32]
Mask = NDArray[np.bool_]
_JUMP, _JUMP_MARGIN = 0.05, 2
_BAD = 0.05
_SEAM_COLUMNS, _POLE_DEG = 4, 80.0
HEADER = (
    "| place | stage | roll: median | > 1 % | turn: median | > 1 % | seam bad % | inside | ratio "
    "| poles bad % | at the equator | ratio |\n" + "|---" * 12 + "|"
)


@dataclass(frozen=True)
class Bad:
    """The share of bad solid angle in one part of the picture, and the same content's elsewhere."""

    there: float
    elsewhere: float

    @property
    def ratio(self) -> float:
        """How much worse it is there."""
        return self.there / self.elsewhere if self.elsewhere else float("nan")


@dataclass(frozen=True)
class Equivariance:
    """What one stage shows.

    Attributes:
        roll: median relative difference, and the share above 1 %.
        turn: likewise.
        seam: bad pixels of the outermost columns.
        poles: bad solid angle above 80°.
    """

    roll: tuple[float, float]
    turn: tuple[float, float]
    seam: Bad
    poles: Bad


def measure(chain: DenseChain, place: Place, folder: Path, *, seed: int = 0) -> dict[str, Equivariance]:
    """Return what each stage that makes range maps shows, by its name."""
    capture, rng = place.capture, np.random.default_rng(seed)
    names, width = list(capture.panoramas), next(iter(capture.panoramas.values())).size_hw[1]
    columns = {name: int(rng.integers(width // 4, 3 * width // 4)) for name in names}
    arbitrary = {names[0]: rotation_from_quat_wxyz(rng.normal(size=4))}
    quarter = dict.fromkeys(names, rotation_from_rotvec((np.pi / 2, 0.0, 0.0)))
    was = chain.run(capture)
    roll = chain.run(rolled(capture, columns, folder / "rolled"))
    turn = chain.run(place.turned(arbitrary, folder / "turned"))
    level = chain.run(place.turned(quarter, folder / "level"))
    smooth = {name: smooth_truth(ranges) for name, ranges in capture.ranges.items()}
    return {
        stage: Equivariance(
            _pooled(_roll_differences(_of(was, stage), back, smooth)),
            _pooled([_turn_difference(was, turn, stage, arbitrary, smooth)]),
            seam_bad(_of(was, stage), back, capture),
            pole_bad(_of(was, stage), _of(level, stage), capture, quarter),
        )
        for stage in was.range_maps
        for back in ({name: np.roll(found, -columns[name], axis=1) for name, found in _of(roll, stage).items()},)
    }


def smooth_truth(truth: Ranges) -> Mask:
    """Return the pixels, (H, W), that have a true range and no jump of it within two pixels."""
    padded = pad_panorama(np.where(np.isfinite(truth), 1 / truth, 0).astype(np.float32), _JUMP_MARGIN)
    window = np.ones((2 * _JUMP_MARGIN + 1,) * 2, np.uint8)
    inner = slice(_JUMP_MARGIN, -_JUMP_MARGIN)
    nearest, farthest = (grow(padded, window)[inner, inner] for grow in (cv2.dilate, cv2.erode))
    # A slanted floor's range changes too: less than this from one side of five pixels to the other.
    slope = _JUMP + 4 * 2 * np.pi / truth.shape[1]
    return np.asarray(nearest <= (1 + slope) * farthest)


def relative_difference(was: Ranges, now: Ranges, new_from_old: NDArray[np.float64], smooth: Mask) -> Ranges:
    """Return |now / was − 1| for the pixels of a turned camera, (N,): both smooth, and with a range in both."""
    height, width = now.shape
    pixels = pixel_from_ray(ray_grid((height, width)) @ new_from_old, was.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 1 / sample_panorama(1 / was, pixels)
        difference = np.abs(now / expected - 1)
    inside = sample_panorama(smooth, pixels) > 0.999
    return np.asarray(difference[inside & np.isfinite(difference)], np.float32)


def seam_bad(was: Mapping[str, Ranges], back: Mapping[str, Ranges], capture: Capture) -> Bad:
    """Return the bad pixels of the outermost columns, there and in ranges of rolled pictures, rolled back."""
    weights, there, elsewhere = [], [], []
    for name, truth in capture.ranges.items():
        height, width = truth.shape
        outer = np.r_[0:_SEAM_COLUMNS, width - _SEAM_COLUMNS : width]
        known = np.isfinite(truth[:, outer])
        weights.append(np.broadcast_to(pixel_solid_angle((height, width))[:, None], known.shape)[known])
        there.append(bad_pixels(was[name], truth)[:, outer][known])
        elsewhere.append(bad_pixels(back[name], truth)[:, outer][known])
    return Bad(*(_share(np.concatenate(bad), np.concatenate(weights)) for bad in (there, elsewhere)))


def pole_bad(
    was: Mapping[str, Ranges], level: Mapping[str, Ranges], capture: Capture, turns: Mapping[str, NDArray[np.float64]]
) -> Bad:
    """Return the bad solid angle of the polar caps, there and when they were at the equator."""
    weights, there, elsewhere = [], [], []
    for name, truth in capture.ranges.items():
        rays = ray_grid(truth.shape)
        cap = (np.abs(rays[..., 1]) > np.sin(np.radians(_POLE_DEG))) & np.isfinite(truth)
        weights.append(np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)[cap])
        there.append(bad_pixels(was[name], truth)[cap])
        column, row = np.moveaxis(np.floor(pixel_from_ray(rays[cap] @ turns[name].T, truth.shape)), -1, 0).astype(int)
        found = level[name][np.clip(row, 0, truth.shape[0] - 1), column % truth.shape[1]]
        elsewhere.append(bad_pixels(found, truth[cap]))
    return Bad(*(_share(np.concatenate(bad), np.concatenate(weights)) for bad in (there, elsewhere)))


def bad_pixels(ranges: Ranges, truth: Ranges) -> Mask:
    """Return where a range is more than 5 % off, or missing."""
    with np.errstate(invalid="ignore"):
        return np.asarray(~(np.abs(ranges - truth) <= _BAD * truth))


def _of(run: DenseRun, stage: str) -> dict[str, Ranges]:
    return {name: range_map.range for name, range_map in run.range_maps[stage].items()}


def _roll_differences(
    was: Mapping[str, Ranges], back: Mapping[str, Ranges], smooth: Mapping[str, Mask]
) -> Iterator[Ranges]:
    for name, first in was.items():
        yield relative_difference(first, back[name], np.eye(3), smooth[name])


def _turn_difference(
    was: DenseRun, now: DenseRun, stage: str, turns: Mapping[str, NDArray[np.float64]], smooth: Mapping[str, Mask]
) -> Ranges:
    name, turn = next(iter(turns.items()))
    return relative_difference(_of(was, stage)[name], _of(now, stage)[name], turn, smooth[name])


def _pooled(differences: Iterator[Ranges] | Sequence[Ranges]) -> tuple[float, float]:
    all_of_them = np.concatenate(list(differences))
    return float(np.median(all_of_them)), float((all_of_them > 0.01).mean())


def _share(bad: Mask, weights: NDArray[np.float64]) -> float:
    return float(weights[bad].sum() / weights.sum()) if weights.size else float("nan")


def line(place: str, stage: str, found: Equivariance) -> str:
    """Return one row of the table."""
    cells = [place, stage]
    for median, share in (found.roll, found.turn):
        cells += [f"{median:.1e}", f"{100 * share:.1f} %"]
    for bad in (found.seam, found.poles):
        cells += [f"{100 * bad.there:.1f}", f"{100 * bad.elsewhere:.1f}", f"{bad.ratio:.2f}"]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="STAGE.PARAM=VALUE")
    parser.add_argument("--scene", action="append", choices=list(SCENES), default=[], help="a synthetic scene")
    parser.add_argument("--data", action="append", default=[], type=Path, metavar="DIR", help="captures with truth")
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0, help="of scenes and turns")
    given = parser.parse_args()
    chain = DenseChain(given.workflow, overrides=given.overrides)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        places: list[Place] = [FolderPlace(path, given.width, given.views) for path in given.data]
        scenes = given.scene or ([] if given.data else ["poles"])
        places += [
            ScenePlace(SCENES[name](seed=given.seed, views=given.views), folder / name, given.width) for name in scenes
        ]
        print(f"{given.workflow} {' '.join(given.overrides)}, {given.width}×{given.width // 2}, {given.views} views")
        print(HEADER)
        for number, place in enumerate(places):
            found = measure(chain, place, folder / str(number), seed=given.seed)
            for stage, figures in found.items():
                print(line(place.capture.name, stage, figures), flush=True)


if __name__ == "__main__":
    main()
