"""Pictures of the guides, from the samples.

    pano-mvs run quickstart
    pano-mvs run compare_sweeps
    python docs/_pictures/guide_pictures.py out/quickstart out/compare_sweeps [NAME...]

NAME: of a picture, such as learned; all pictures without one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from pano_mvs_photographs.learned_matches import match_photograph, view_of_photograph
from quickstart_pictures import IMAGES, ROOT

import pano_mvs
from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.learned.aliked import extract_aliked
from pano_mvs.algorithms.learned.lightglue import match_learned
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.geometry import pixel_from_ray, ray_grid
from pano_mvs.io.images.preview import color_mapped, range_limits
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.scene import Features

CLASSROOM = ROOT / "workflows" / "samples" / "classroom"
ROOMS = ROOT / "workflows" / "samples" / "real_rooms" / "images"
UP = np.array([0.0, -1.0, 0.0])
WIDTH, GAP = 560, 10
INK, PAPER = (40, 40, 40), (255, 255, 255)

Picture = NDArray[np.uint8]


def read(path: Path) -> Picture:
    """Return an image file, RGB."""
    return np.asarray(cv2.cvtColor(np.asarray(cv2.imread(str(path)), np.uint8), cv2.COLOR_BGR2RGB), np.uint8)


def at_width(picture: Picture, width: int = WIDTH) -> Picture:
    """Return a picture at a width."""
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def beside(*pictures: Picture) -> Picture:
    """Return pictures of one height in a row, with gaps."""
    gap = np.full((len(pictures[0]), GAP, 3), PAPER, np.uint8)
    return np.hstack([part for picture in pictures for part in (picture, gap)][:-1])


def above(*pictures: Picture) -> Picture:
    """Return pictures of one width below each other, with gaps."""
    gap = np.full((GAP, pictures[0].shape[1], 3), PAPER, np.uint8)
    return np.vstack([part for picture in pictures for part in (picture, gap)][:-1])


def titled(picture: Picture, title: str) -> Picture:
    """Return a picture with a line of text above it."""
    strip = np.full((26, picture.shape[1], 3), PAPER, np.uint8)
    cv2.putText(strip, title, (2, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    return np.vstack([strip, picture])


def fisheye(panorama: Picture, turn_rad: float, *, size: int = 200, field_deg: float = 190) -> Picture:
    """Return what an equidistant lens in the place of a panorama sees, in a black square."""
    x, y = (np.indices((size, size))[::-1] + 0.5 - size / 2) * 2 / size
    radius = np.hypot(x, y)
    angle = np.minimum(radius, 1) * np.deg2rad(field_deg) / 2
    with np.errstate(invalid="ignore"):
        across, down = (np.sin(angle) * part / radius for part in (x, y))
    ahead = np.cos(angle)
    turned = (
        np.cos(turn_rad) * across + np.sin(turn_rad) * ahead,
        np.cos(turn_rad) * ahead - np.sin(turn_rad) * across,
    )
    at = pixel_from_ray(np.stack([turned[0], down, turned[1]], axis=-1), (panorama.shape[0], panorama.shape[1])) - 0.5
    places = at.astype(np.float32)
    seen = cv2.remap(panorama, places[..., 0], places[..., 1], cv2.INTER_AREA, borderMode=cv2.BORDER_WRAP)
    return np.where((radius < 1)[..., None], seen, 0).astype(np.uint8)


def input_picture(_run: Path, _sweeps: Path) -> Picture:
    """What is read: a full panorama, and a cropped one on its sphere; and what is refused: two fisheye circles."""
    full = at_width(read(CLASSROOM / "images" / "000.png"), 400)
    cropped = np.full_like(full, 225)
    cropped[40:150, 60:330] = full[40:150, 60:330]
    circles = np.hstack([fisheye(read(CLASSROOM / "images" / "000.png"), turn) for turn in (0.0, np.pi)])
    return beside(
        titled(full, "full sphere"),
        titled(cropped, "cropped, placed by GPano metadata"),
        titled(circles, "refused: not stitched"),
    )


def lines_between(first: Picture, second: Picture, ends: NDArray[np.float64]) -> Picture:
    """Return two pictures above each other, with lines between pixels (N, 4) of both."""
    shown = above(first, second)
    rng = np.random.default_rng(1)
    for x, y, other_x, other_y in np.rint(ends).astype(int).tolist():
        color = cv2.cvtColor(np.uint8([[[rng.integers(180), 200, 230]]]), cv2.COLOR_HSV2RGB)[0, 0].tolist()  # type: ignore[call-overload]
        start, end = (x, y), (other_x, other_y + len(first) + GAP)
        cv2.line(shown, start, end, color, 1, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(shown, place, 2, color, -1, cv2.LINE_AA)
    return shown


def pair_picture(pictures: list[Picture], features: list[Features], matches: NDArray[np.int32]) -> Picture:
    """Return two panoramas with their verified matches."""
    small = [at_width(picture) for picture in pictures]
    sizes = [(picture.shape[0], picture.shape[1]) for picture in small]
    ends = [pixel_from_ray(one.bearings[matches[:, n]], sizes[n]) for n, one in enumerate(features)]
    return lines_between(*small, np.hstack(ends))


def learned_picture(_run: Path, _sweeps: Path) -> Picture:
    """The verified matches of two real panoramas 3 to 5 m apart: by SIFT, and by the networks."""
    pictures = [read(ROOMS / f"{name}.jpg") for name in ("dining", "living")]
    every = np.ones(pictures[0].shape[:2], np.bool_)
    sift = [extract_sift(picture, every) for picture in pictures]
    learned = [extract_aliked(picture, every, up=UP) for picture in pictures]
    columns = []
    for title, features, candidates in (
        ("SIFT", sift, match_features(*sift)),
        ("ALIKED and LightGlue", learned, match_learned(*learned)),
    ):
        matches = verify_pair(*features, candidates, rng=np.random.default_rng(0)).matches_idx
        columns.append(titled(pair_picture(pictures, features, matches), f"{title}: {len(matches)} verified matches"))
    return beside(*columns)


def photographs_picture(_run: Path, _sweeps: Path) -> Picture:
    """A pinhole view of one panorama in the place of a photograph, and its matches with another panorama."""
    other, panorama = (read(ROOMS / f"{name}.jpg") for name in ("living", "dining"))
    x, y = np.indices((384, 512))[::-1] - np.array([255.5, 191.5])[:, None, None]
    rays = np.stack([x, y + 20.0, np.full(x.shape, 400.0)], axis=-1)
    at = (pixel_from_ray(rays, (other.shape[0], other.shape[1])) - 0.5).astype(np.float32)
    photograph = np.asarray(cv2.remap(other, at[..., 0], at[..., 1], cv2.INTER_CUBIC), np.uint8)
    features = extract_aliked(panorama, np.ones(panorama.shape[:2], np.bool_), up=UP)
    view = view_of_photograph(photograph)
    matches = match_photograph(view, features)
    small, wide = at_width(photograph, WIDTH // 2), at_width(panorama, 2 * WIDTH // 2)
    framed = np.full((len(small), WIDTH, 3), PAPER, np.uint8)
    left = WIDTH // 4
    framed[:, left : left + small.shape[1]] = small
    ends = np.hstack(
        [
            view.pixels_px[matches[:, 0]] * small.shape[1] / photograph.shape[1] + (left, 0),
            pixel_from_ray(features.bearings[matches[:, 1]], (wide.shape[0], wide.shape[1])),
        ]
    )
    return lines_between(framed, wide, ends[:: max(1, len(ends) // 60)])


def sweep_picture(_run: Path, sweeps: Path) -> Picture:
    """The ranges of one view: from census and semi-global matching, and from the paper's parts."""
    maps = [read_range_tiff(sweeps / place / "range" / "000.tiff") for place in ("", "sad")]
    truth = np.load(CLASSROOM / "truth" / "depth.npz")["000"].astype(np.float32)
    limits = range_limits(maps[0])
    shown = [at_width(color_mapped(one, *limits), 400) for one in (*maps, np.where(np.isfinite(truth), truth, np.nan))]
    titles = ("census_gradient, sgm", "sad, box (the paper)", "ground truth")
    return beside(*(titled(picture, title) for picture, title in zip(shown, titles, strict=True)))


def method_picture(_run: Path, _sweeps: Path) -> Picture:
    """The mean of a panorama and another one, projected at one range for all pixels: sharp where the range is right."""
    poses = read_poses(CLASSROOM / "truth" / "poses.json")
    first, second = poses.cam_from_world(0), poses.cam_from_world(1)
    reference, source = (read(CLASSROOM / "images" / name) for name in ("000.png", "001.png"))
    size_hw = reference.shape[0], reference.shape[1]
    tiles = []
    for distance in (0.62, 1.2, 3.2):  # the front desk; nothing much; the wall
        points = (second @ first.inverse()).apply(ray_grid(size_hw) * distance)
        at = (pixel_from_ray(points / np.linalg.norm(points, axis=-1, keepdims=True), size_hw) - 0.5).astype(np.float32)
        seen = cv2.remap(source, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        mixed = (0.5 * reference + 0.5 * seen)[150:420, 60:500]
        tiles.append(titled(at_width(np.rint(mixed).astype(np.uint8), 400), f"projected at {distance:g} m"))
    return beside(*tiles)


def colmap_picture(run: Path, _sweeps: Path) -> Picture:
    """The sparse points of the exported model in the panorama of a camera, coloured by their range."""
    poses = pano_mvs.load(run).poses
    assert poses is not None
    panorama = at_width(read(CLASSROOM / "images" / "000.png"), 1024)
    size_hw = panorama.shape[0], panorama.shape[1]
    points = poses.cam_from_world(poses.names.index("000.png")).apply(poses.points_in_world)
    ranges = np.linalg.norm(points, axis=-1)
    places = np.rint(pixel_from_ray(points / ranges[:, None], size_hw)).astype(int)
    colors = color_mapped(ranges[None].astype(np.float32), *range_limits(ranges[None].astype(np.float32)))[0]
    shown = (0.6 * panorama + 0.4 * 255).astype(np.uint8)
    for (x, y), color in zip(places.tolist(), colors.tolist(), strict=True):
        cv2.circle(shown, (x, y), 4, (30, 30, 30), -1, cv2.LINE_AA)
        cv2.circle(shown, (x, y), 3, color, -1, cv2.LINE_AA)
    return at_width(shown, 900)


def benchmarks_picture(run: Path, _sweeps: Path) -> Picture:
    """The ranges of quickstart, the ground truth, and where they differ."""
    estimate = read_range_tiff(run / "range" / "000.tiff")
    truth = np.load(CLASSROOM / "truth" / "depth.npz")["000"].astype(np.float32)
    truth[~np.isfinite(truth)] = np.nan
    error = np.abs(estimate / truth - 1)
    shown = cv2.applyColorMap(
        np.rint(255 * np.clip(np.nan_to_num(error) / 0.1, 0, 1)).astype(np.uint8), cv2.COLORMAP_MAGMA
    )
    limits = range_limits(truth)
    tiles = [color_mapped(estimate, *limits), color_mapped(truth, *limits), cv2.cvtColor(shown, cv2.COLOR_BGR2RGB)]
    titles = ("quickstart", "ground truth", "relative error, black 0 to white 10 %")
    return beside(
        *(titled(at_width(np.asarray(tile, np.uint8), 400), title) for tile, title in zip(tiles, titles, strict=True))
    )


def python_picture(run: Path, _sweeps: Path) -> Picture:
    """The figure of range maps that the notebook draws."""
    mpl.use("agg")
    notebook = json.loads((ROOT / "docs" / "python.ipynb").read_text(encoding="utf-8"))
    (cell,) = [cell for cell in notebook["cells"] if "range_map, norm=" in "".join(cell["source"])]
    exec("".join(cell["source"]), {"run": pano_mvs.load(run), "plt": plt, "np": np})  # noqa: S102  # our own notebook
    figure = plt.gcf()
    figure.set_dpi(80)
    figure.tight_layout()
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba(), np.uint8)[..., :3]  # type: ignore[attr-defined]


PICTURES: dict[str, Callable[[Path, Path], Picture]] = {
    "input_kinds": input_picture,
    "learned_matches": learned_picture,
    "photograph_matches": photographs_picture,
    "sweep_costs": sweep_picture,
    "method_hypotheses": method_picture,
    "colmap_points": colmap_picture,
    "benchmarks_errors": benchmarks_picture,
    "python_ranges": python_picture,
}


if __name__ == "__main__":
    places, names = [Path(word) for word in sys.argv[1:3]], sys.argv[3:]
    for name in names or PICTURES:
        shown = cv2.cvtColor(PICTURES[name](*places), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(IMAGES / f"{name}.jpg"), shown, [cv2.IMWRITE_JPEG_QUALITY, 80])
