"""How much of people is masked, and of everything else.

Draws people into the panoramas of a synthetic court with four kinds of ground, and of captures with true poses and
ranges (`rgb/`, `poses.json` and `depth.npz`). A different person crouches below the camera in each view, others stand
beside it or walk; all views show everybody. Prints for each kind of person the share of their pixels that
`masks.operator` and `masks.moving` mask, and the share of the sphere that they mask elsewhere, and the CPU time of a
panorama. `masks.moving` reads the true ranges with noise, in which half of the people have the ranges of the ground.

`--marks FILE IMAGES` measures instead what `masks.static` and `masks.operator` mask of hand-marked polygons in a folder
of images: JSON with `size_hw` and `polygons`, image name to polygons of (x, y).
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import dilated, share_of_sphere
from pano_mvs.algorithms.masks.expected_view import OtherView
from pano_mvs.algorithms.masks.moving import MAX_OTHERS, moving_pixels
from pano_mvs.algorithms.masks.people import people
from pano_mvs.algorithms.masks.static_content import static_content
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.image_file import decode_image
from pano_mvs.testing.room import noise
from tests.synthetic.persons import OUTFITS, Person, draw_people, person
from tests.synthetic.scenes import courtyard
from tools.benchmarks.captures import read_capture

View = tuple[Picture, NDArray[np.float32], Rigid3]

SIZE_HW = (256, 512)
GROUNDS = ("stone", "asphalt", "tiles", "grass")
BELOW = ("crouching", "bent", "squatting", "sitting")


@dataclass(frozen=True, eq=False)
class Populated:
    """A view with people: picture, ranges, pose, kind of person to their pixels."""

    picture: Picture
    ranges: NDArray[np.float32]
    empty_ranges: NDArray[np.float32]
    pose: Rigid3
    shown: dict[str, Mask]

    @property
    def everybody(self) -> Mask:
        """All pixels of people and their shadows."""
        return np.asarray(np.logical_or.reduce(list(self.shown.values())))


def synthetic_views(ground: str, *, views: int, seed: int) -> tuple[list[View], float]:
    """Return views of the court with a ground, and its height."""
    scene = courtyard(seed=seed, views=views, turned=False, exposure=0.05)
    found = []
    for idx, pose in enumerate(scene.poses):
        picture, ranges = scene.view(idx, SIZE_HW, supersample=1)
        found.append((_with_ground(picture, ranges, pose, ground=ground), ranges, pose))
    return found, 1.6


def captured_views(folder: Path, *, views: int) -> tuple[list[View], float]:
    """Return views of a capture with truth, and the height of its ground: the median of what lies below the cameras."""
    capture = read_capture(folder, width=SIZE_HW[1]).first(views)
    rays = ray_grid(SIZE_HW)
    down = rays[..., 1] > 0.9
    found = [(image.load(), capture.ranges[name], capture.poses[name]) for name, image in capture.panoramas.items()]
    points = [pose.center + rays[down] * ranges[down, None] for _, ranges, pose in found]
    return found, float(np.max([np.nanmedian(each[:, 1]) for each in points]))


def populated(views: Sequence[View], ground_y: float, *, seed: int) -> list[Populated]:
    """Return the views, each with an operator of its own below or beside the camera, and a passer-by."""
    rng = np.random.default_rng(seed)
    outfits = list(OUTFITS)
    result = []
    for idx, (picture, ranges, pose) in enumerate(views):
        crew: list[tuple[str, Person]] = []
        kind = "standing" if idx % 5 == 4 else BELOW[idx % len(BELOW)]
        reach = rng.uniform(0.5, 0.9) if kind == "standing" else rng.uniform(0, 0.4)
        crew.append((kind, _somebody(kind, outfits[idx % len(outfits)], pose, ground_y, reach=reach, rng=rng)))
        crew.append(("walking", _somebody("walking", "shirt", pose, ground_y, reach=rng.uniform(1.5, 3.5), rng=rng)))
        shown: dict[str, Mask] = {}
        now, depth = picture, ranges
        for name, body in crew:
            drawn = draw_people(now, depth, pose, people=[body])
            shown = {other: pixels & ~drawn.people for other, pixels in shown.items()}
            now, depth = drawn.picture, drawn.ranges
            shown |= {name: drawn.people}
            shown["shadow"] = (shown.get("shadow", drawn.shadow) | drawn.shadow) & ~drawn.people
        result.append(Populated(now, depth, ranges, pose, shown))
    return result


def measured(views: Sequence[Populated]) -> Iterator[tuple[Populated, Mask, Mask, tuple[float, float]]]:
    """Yield for each view what masks.operator finds, and what masks.moving adds, and their CPU times."""
    rng = np.random.default_rng(0)
    everything = np.ones(SIZE_HW, np.bool_)
    firsts, seconds = [], []
    for view in views:
        start = time.process_time()
        found = people(cv2.resize(view.picture, (1024, 512), interpolation=cv2.INTER_CUBIC))
        seconds.append(time.process_time() - start)
        firsts.append(cv2.resize(found.astype(np.uint8), SIZE_HW[::-1], interpolation=cv2.INTER_NEAREST) > 0)
    for idx, view in enumerate(views):
        others = [other for other in range(len(views)) if other != idx]
        others.sort(key=lambda other: float(np.linalg.norm(views[other].pose.center - view.pose.center)))
        near = [
            OtherView(
                views[other].picture, everything, _noisy(views[other], rng), views[other].pose @ view.pose.inverse()
            )
            for other in others[:MAX_OTHERS]
        ]
        start = time.process_time()
        second = moving_pixels(view.picture, _noisy(view, rng), near, valid=everything).pixels
        yield view, firsts[idx], second, (seconds[idx], time.process_time() - start)


def marked(file: Path, images: Path) -> None:
    """Print what masks.static and masks.operator mask of hand-marked areas."""
    marks = json.loads(file.read_text(encoding="utf-8"))
    pictures = [decode_image(images / name) for name in marks["polygons"]]
    small = [np.ascontiguousarray(cv2.resize(p, SIZE_HW[::-1], interpolation=cv2.INTER_AREA)) for p in pictures]
    static = static_content(small).pixels
    for (name, polygons), picture in zip(marks["polygons"].items(), pictures, strict=True):
        drawn = np.zeros(marks["size_hw"], np.uint8)
        for polygon in polygons:
            cv2.fillPoly(drawn, [np.array(polygon, np.int32)], (1,))
        truth = cv2.resize(drawn, SIZE_HW[::-1], interpolation=cv2.INTER_AREA) > 0
        found = people(np.ascontiguousarray(picture)).astype(np.uint8)
        own = cv2.resize(found, SIZE_HW[::-1], interpolation=cv2.INTER_NEAREST) > 0
        both = own | static
        print(
            f"{name:24} operator {_share(own, truth):6.1%}  static {_share(static, truth):6.1%}  both "
            f"{_share(both, truth):6.1%}  elsewhere {share_of_sphere(both & ~dilated(truth, 3)):.2%}"
        )


def main(
    captures: Annotated[list[Path] | None, typer.Argument()] = None,
    views: int = 5,
    seed: int = 1,
    marks: tuple[Path, Path] | None = None,
) -> None:
    """Print the tables.

    Args:
        captures: folders with rgb/, poses.json and depth.npz.
        views: views of each place.
        seed: of places and people.
        marks: hand-marked areas: a file, and the folder of its images.
    """
    if marks:
        marked(*marks)
        return
    places = {ground: synthetic_views(ground, views=views, seed=seed) for ground in GROUNDS}
    places |= {folder.name: captured_views(folder, views=views) for folder in captures or ()}
    by_kind: dict[str, list[tuple[float, float, float]]] = {}
    for place, (shown, ground_y) in places.items():
        rest: list[tuple[float, ...]] = []
        for view, first, second, seconds in measured(populated(shown, ground_y, seed=seed)):
            for kind, pixels in view.shown.items():
                if share_of_sphere(pixels) > 5e-4:
                    shares = _share(first, pixels), _share(second, pixels), _share(first | second, pixels)
                    by_kind.setdefault(kind, []).append(shares)
            far = ~dilated(view.everybody, 4)
            rest.append((share_of_sphere(first & far), share_of_sphere(second & far), *seconds))
        worst, median = np.max(rest, axis=0), np.median(rest, axis=0)
        print(
            f"{place:12} elsewhere at most: operator {worst[0]:.2%}, moving {worst[1]:.2%}; "
            f"CPU s: {median[2]:.2f}, {median[3]:.2f}"
        )
    for kind, found in sorted(by_kind.items()):
        mean, least = np.mean(found, axis=0), np.min(found, axis=0)
        print(
            f"{kind:12} {len(found):3}  operator {mean[0]:6.1%} (least {least[0]:6.1%})  moving {mean[1]:6.1%} "
            f"({least[1]:6.1%})  both {mean[2]:6.1%} ({least[2]:6.1%})"
        )


def _somebody(
    pose_name: str, outfit: str, pose: Rigid3, ground_y: float, *, reach: float, rng: np.random.Generator
) -> Person:
    azimuth, heading = rng.uniform(0, 2 * np.pi, 2)
    x, z = pose.center[0] + reach * np.cos(azimuth), pose.center[2] + reach * np.sin(azimuth)
    seed = int(rng.integers(1 << 30))
    return person(pose_name, outfit, at_xz=(float(x), float(z)), ground_y=ground_y, heading=heading, seed=seed)


def _noisy(view: Populated, rng: np.random.Generator) -> RangeMap:
    ranges = view.ranges if rng.random() < 0.5 else view.empty_ranges
    noisy = (ranges * (1 + 0.004 * rng.normal(size=ranges.shape))).astype(np.float32)
    return RangeMap(noisy, np.where(np.isfinite(noisy), 200, 0).astype(np.uint8))


def _with_ground(picture: Picture, ranges: NDArray[np.float32], pose: Rigid3, *, ground: str) -> Picture:
    """Return a picture with another ground."""
    if ground == "stone":
        return picture
    rays = ray_grid(SIZE_HW) @ pose.rotation
    points = pose.center + np.nan_to_num(ranges)[..., None] * rays
    on = np.isfinite(ranges) & (np.abs(points[..., 1] - 1.6) < 0.02) & (rays[..., 1] > 0.02)
    at, footprint = points[on], np.pi / SIZE_HW[0] * ranges[on] / np.maximum(rays[on][:, 1], 0.1)

    def octave(size: float, seed: int) -> NDArray[np.float64]:
        return np.exp(-((2 * footprint / (7 * size)) ** 2)) * noise(at, cells=((size, 1.0),), seed=seed)

    if ground == "asphalt":
        shade = 1 + 0.18 * octave(0.002, 1) + 0.12 * octave(0.01, 2) + 0.1 * octave(0.2, 3)
        colors = np.array([0.33, 0.33, 0.34]) * shade[:, None]
    elif ground == "grass":
        shade = 1 + 0.3 * octave(0.003, 1) + 0.2 * octave(0.01, 2) + 0.15 * octave(0.1, 3)
        colors = np.array([0.25, 0.36, 0.13]) * shade[:, None]
    else:
        joint = np.maximum(np.abs((at[:, 0] / 0.4) % 1 - 0.5), np.abs((at[:, 2] / 0.4) % 1 - 0.5)) > 0.48
        shade = np.where(joint, 0.6, 1 + 0.06 * octave(0.01, 2) + 0.06 * octave(0.05, 3))
        colors = np.array([0.62, 0.58, 0.53]) * shade[:, None]
    result = picture.copy()
    result[on] = np.clip(242 * colors, 0, 255)
    return result


def _share(pixels: Mask, of: Mask) -> float:
    return share_of_sphere(pixels & of) / max(share_of_sphere(of), 1e-12)
