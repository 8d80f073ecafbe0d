"""Does it matter where in the picture a thing is.

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

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import Mask
from pano_mvs.geometry import (
    Rigid3,
    pad_panorama,
    pixel_from_ray,
    pixel_solid_angle,
    ray_grid,
    roll_panorama,
    rotation_from_quat_wxyz,
    rotation_from_rotvec,
    sample_panorama,
)
from pano_mvs.scene import FilePart, Panorama
from tests.synthetic.scenes import SCENES, Scene
from tools.benchmarks.captures import Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, DenseRun, Overrides
from tools.benchmarks.table import print_table

Ranges = NDArray[np.float32]
Turns = Mapping[str, NDArray[np.float64]]
_MARGIN_PX = 8
_RAYS_PER_PIXEL = 3
_JUMP, _JUMP_MARGIN = 0.05, 2
_BAD = 0.05
_SEAM_COLUMNS, _POLE_DEG = 4, 80.0


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


def row(place: str, stage: str, found: Equivariance) -> list[str]:
    """Return one row of the table."""
    cells = [place, stage]
    for median, share in (found.roll, found.turn):
        cells += [f"{median:.1e}", f"{100 * share:.1f} %"]
    for bad in (found.seam, found.poles):
        cells += [f"{100 * bad.there:.1f}", f"{100 * bad.elsewhere:.1f}", f"{bad.ratio:.2f}"]
    return cells


class Place(Protocol):
    """Where pictures come from, whichever way the cameras are turned."""

    @property
    def capture(self) -> Capture:
        """The capture as it is."""
        ...

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the capture with some cameras, by name, turned by new_from_old (3, 3); pictures go to the folder."""
        ...


@dataclass(frozen=True)
class ScenePlace:
    """A synthetic scene, rendered afresh for every turn, so that no resampling blurs anything.

    Sensor noise is left out: two draws of it are no question of equivariance.
    """

    scene: Scene
    folder: Path
    width: int

    @property
    def capture(self) -> Capture:
        """The scene as it is."""
        return scene_capture(self._still, self.folder / "as-is", width=self.width)

    @property
    def _still(self) -> Scene:
        return dataclasses.replace(self.scene, noise=0.0)

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the scene with some cameras turned."""
        named = {f"{idx:03d}.png": pose for idx, pose in enumerate(self.scene.poses)}
        poses = tuple(_turn(pose, turns.get(name)) for name, pose in named.items())
        return scene_capture(dataclasses.replace(self._still, poses=poses), folder, width=self.width)


@dataclass(frozen=True)
class FolderPlace:
    """A rendered capture on disk; turned pictures are averages of nine Lanczos samples of the file's own pixels.

    At the file's own resolution some blur remains, at half of it next to none.
    """

    source: Path
    width: int
    views: int

    @property
    def capture(self) -> Capture:
        """The capture as it is."""
        return read_capture(self.source, width=self.width).first(self.views)

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the capture with some cameras turned."""
        whole, capture = read_capture(self.source).first(self.views), self.capture
        panoramas, ranges = dict(capture.panoramas), dict(capture.ranges)
        for name, turn in turns.items():
            picture = turned_picture(whole.panoramas[name].load(), turn, capture.panoramas[name].size_hw)
            panoramas[name] = written(picture, folder / name)
            ranges[name] = _nearest(whole.ranges[name], turn, picture.shape[:2])
        poses = {name: _turn(pose, turns.get(name)) for name, pose in capture.poses.items()}
        return dataclasses.replace(capture, panoramas=panoramas, poses=poses, ranges=ranges)


def rolled(capture: Capture, columns: Mapping[str, int], folder: Path) -> Capture:
    """Return the capture with each picture rolled to the right by its own number of columns, exactly."""
    panoramas, poses, ranges = {}, {}, {}
    for name, panorama in capture.panoramas.items():
        picture, turn = roll_panorama(panorama.load(), columns[name])
        panoramas[name] = written(picture, folder / name)
        poses[name] = _turn(capture.poses[name], turn)
        ranges[name] = np.roll(capture.ranges[name], columns[name], axis=1)
    return dataclasses.replace(capture, panoramas=panoramas, poses=poses, ranges=ranges)


def turned_picture(
    picture: NDArray[np.uint8], new_from_old: NDArray[np.float64], size_hw: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return what a turned camera sees, (h, w, 3), of a larger or equally large panorama (H, W, 3)."""
    total = np.zeros((*size_hw, 3))
    for part in np.ndindex(_RAYS_PER_PIXEL, _RAYS_PER_PIXEL):
        fine = (_RAYS_PER_PIXEL * size_hw[0], _RAYS_PER_PIXEL * size_hw[1])
        rays = ray_grid(fine)[part[0] :: _RAYS_PER_PIXEL, part[1] :: _RAYS_PER_PIXEL] @ new_from_old
        x, y = np.moveaxis(pixel_from_ray(rays, picture.shape[:2]) + _MARGIN_PX - 0.5, -1, 0).astype(np.float32)
        padded = pad_panorama(picture, _MARGIN_PX)
        total += cv2.remap(padded, x, y, cv2.INTER_LANCZOS4).astype(np.float64)
    return np.asarray(np.rint(total / _RAYS_PER_PIXEL**2), dtype=np.uint8)


def written(picture: NDArray[np.uint8], path: Path) -> Panorama:
    """Write an RGB picture without loss and return it as a panorama."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lossless = path.with_suffix(".png")
    cv2.imwrite(str(lossless), picture[..., ::-1])
    size = picture.shape[0], picture.shape[1]
    return Panorama(FilePart(lossless), size, size)


def _turn(pose: Rigid3, new_from_old: NDArray[np.float64] | None) -> Rigid3:
    return pose if new_from_old is None else Rigid3(new_from_old, np.zeros(3)) @ pose


def _nearest(
    ranges: NDArray[np.float32], new_from_old: NDArray[np.float64], size_hw: tuple[int, int]
) -> NDArray[np.float32]:
    """Return the ranges of the pixels in which a turned camera's rays arrive, (h, w)."""
    height, width = ranges.shape
    column, row = np.moveaxis(np.floor(pixel_from_ray(ray_grid(size_hw) @ new_from_old, (height, width))), -1, 0)
    result: NDArray[np.float32] = ranges[np.clip(row, 0, height - 1).astype(int), np.mod(column, width).astype(int)]
    return result


def main(
    workflow: str = "quality",
    overrides: Overrides = None,
    scene: list[str] | None = None,
    data: list[Path] | None = None,
    width: int = 512,
    views: int = 4,
    seed: int = 0,
) -> None:
    """Print the table.

    Args:
        workflow: preset or file.
        overrides: as `--set` of `run`.
        scene: synthetic scenes; default poles, if there is no `data`.
        data: captures with truth.
        width: of the panoramas.
        views: number of views.
        seed: of scenes and turns.
    """
    chain = DenseChain(workflow, overrides=overrides or ())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        places: list[Place] = [FolderPlace(path, width, views) for path in data or ()]
        places += [
            ScenePlace(SCENES[name](seed=seed, views=views), folder / name, width)
            for name in scene or ([] if data else ["poles"])
        ]

        def rows() -> Iterator[list[str]]:
            for number, place in enumerate(places):
                for stage, figures in measure(chain, place, folder / str(number), seed=seed).items():
                    yield row(place.capture.name, stage, figures)

        columns = ["place", "stage", "roll: median", "> 1 %", "turn: median", "> 1 %", "seam bad %", "inside", "ratio"]
        print_table([*columns, "poles bad %", "at the equator", "ratio"], rows())
