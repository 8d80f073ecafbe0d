"""Rooms of single panoramas against the truth.

Each DIR is a house of `poses.tours.houses`, with the name of the house, or a tour of ZInD such as sample_tour/000. Its
panoramas say together how high ceilings are. Walls are compared at each degree of azimuth, without those of doors and
openings; cameras in a stairwell, and those of ZInD that are in no room, are left out. ZInD's outlines were drawn by
hand, with a camera at one height. The first table shows errors of the distances of walls, the second how often they are
within 5 % where the stated probability is in some range.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import reduced_panorama
from pano_mvs.algorithms.structure.room_outlines import ceilings_of, lines_of, outline_of
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.rooms import OUTLINE_AZIMUTHS, RoomOutline
from tools.benchmarks.poses.tours.houses import HOUSES
from tools.benchmarks.poses.tours.plan import WALL, Opening, rooms_of

HEADER = (
    "| tour | rooms | height of the ceiling within 3 % | walls: median error | within 5 % | CPU-s |\n"
    + "|---" * 6
    + "|"
)
_WIDTH_PX = 1024
_RANGES = (0.0, 0.4, 0.6, 0.8, 1.0)


class TrueRoom(NamedTuple):
    """A panorama and the room around it, in heights of the camera, at azimuths to the right of the picture's middle."""

    picture: Path
    distances: FloatArray  # (360,)
    is_open: NDArray[np.bool_]  # (360,) whether there is a door or an opening
    ceiling: float  # above the camera


def true_rooms(folder: Path) -> Iterator[TrueRoom]:
    """Yield the rooms of a house or a tour.

    Raises:
        SystemExit: if the folder is neither.
    """
    if (folder / "zind_data.json").is_file():
        yield from _of_zind(folder)
    elif folder.name in HOUSES and (folder / "truth.json").is_file():
        yield from _of_house(folder)
    else:
        raise SystemExit(f"{folder}: neither a rendered house nor a tour of ZInD")


def wall_distances(corners: FloatArray, azimuths_rad: FloatArray) -> FloatArray:
    """Return the distance from the origin to a polygon (N, 2), x to the right and y ahead, at azimuths (A,)."""
    ahead = np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)
    nearest = np.full(len(ahead), np.inf)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = end - start
        across = ahead[:, 0] * side[1] - ahead[:, 1] * side[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[0] * side[1] - start[1] * side[0]) / across
            place = (start[0] * ahead[:, 1] - start[1] * ahead[:, 0]) / across
        meets = (distance > 0) & (place > -1e-9) & (place < 1 + 1e-9)
        nearest = np.where(meets & (distance < nearest), distance, nearest)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _of_house(folder: Path) -> Iterator[TrueRoom]:
    rooms, openings = rooms_of(HOUSES[folder.name], seed=int(folder.name.rpartition("_")[2]))
    by_name = {room.name: room for room in rooms}
    for file, about in json.loads((folder / "truth.json").read_text(encoding="utf-8")).items():
        room = by_name.get(about["room"])
        if room is None:
            continue
        center = np.array(about["position_m"])
        height = center[2] - room.floor
        ahead = np.array(about["camera_from_world"])[2]
        azimuths = np.radians(np.arange(OUTLINE_AZIMUTHS)) + np.arctan2(ahead[0], ahead[1])
        x0, y0, x1, y1 = np.array(room.rectangle) + np.array([1, 1, -1, -1]) * WALL / 2
        distances = wall_distances(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) - center[:2], azimuths)
        places = center[:2] + distances[:, None] * np.stack([np.sin(azimuths), np.cos(azimuths)], axis=-1)
        is_open = np.zeros(OUTLINE_AZIMUTHS, np.bool_)
        for opening in openings:
            if abs(opening.floor - room.floor) < 0.1 and opening.bottom < 0.3:
                is_open |= _is_in(places, opening)
        yield TrueRoom(folder / "images" / file, distances / height, is_open, (room.height - height) / height)


def _is_in(places: FloatArray, opening: Opening) -> NDArray[np.bool_]:
    along, across = (places[:, 0], places[:, 1]) if opening.axis == 0 else (places[:, 1], places[:, 0])
    return np.asarray((np.abs(across - opening.line) < WALL) & (along > opening.start) & (along < opening.end))


def _of_zind(folder: Path) -> Iterator[TrueRoom]:
    known = json.loads((folder / "zind_data.json").read_text(encoding="utf-8"))
    azimuths = np.radians(np.arange(OUTLINE_AZIMUTHS))
    panoramas: list[dict[str, Any]] = [
        panorama
        for rooms in known["merger"].values()
        for parts in rooms.values()
        for part in parts.values()
        for panorama in part.values()
    ]
    for panorama in panoramas:
        layout = panorama.get("layout_visible")
        if layout is None or not panorama["is_inside"]:
            continue
        mirrored = np.array([-1.0, 1.0])
        is_open = np.zeros(OUTLINE_AZIMUTHS, np.bool_)
        for start, end, _ in np.array([*layout["doors"], *layout["openings"]]).reshape(-1, 3, 2):
            is_open |= np.isfinite(wall_distances(np.array([start, end]) * mirrored, azimuths))
        distances = wall_distances(np.array(layout["vertices"]) * mirrored, azimuths)
        yield TrueRoom(folder / panorama["image_path"], distances, is_open, panorama["ceiling_height"] - 1.0)


def outlines(rooms: list[TrueRoom]) -> list[RoomOutline]:
    """Return the outline of each room, with what all of their pictures say of the ceiling."""
    pictures = [reduced_panorama(decode_image(room.picture), _WIDTH_PX) for room in rooms]
    lines = [lines_of(picture, np.ones(picture.shape[:2], np.bool_)) for picture in pictures]
    ceilings = ceilings_of(lines)
    return [outline_of(picture, one, ceilings) for picture, one in zip(pictures, lines, strict=True)]


def main(tours: list[Path]) -> None:
    """Outline the rooms of houses and tours, and compare them."""
    print(HEADER, flush=True)
    stated, right = [], []
    for tour in tours:
        rooms = list(true_rooms(tour))
        started = time.process_time()
        found = outlines(rooms)
        cpu_s = time.process_time() - started
        heights = [one.ceiling is not None and abs(one.ceiling / room.ceiling - 1) < 0.03
                   for one, room in zip(found, rooms, strict=True)]  # fmt: skip
        errors = []
        for one, room in zip(found, rooms, strict=True):
            counted = ~room.is_open & np.isfinite(room.distances)
            off = np.abs(np.where(np.isfinite(one.distances), one.distances, np.inf) / room.distances - 1)[counted]
            errors.append(off)
            stated.append(one.probabilities[counted])
            right.append(off < 0.05)
        every = np.concatenate(errors)
        print(
            f"| {tour.name} | {len(rooms)} | {sum(heights)} | {np.median(every):.1%} | {np.mean(every < 0.05):.0%} | "
            f"{cpu_s:.0f} |",
            flush=True,
        )
    probability, is_right = np.concatenate(stated), np.concatenate(right)
    print("\n| stated | in the mean | right | azimuths |\n|---|---|---|---|")
    for low, high in pairwise(_RANGES):
        inside = (probability > low) & (probability <= high)
        if inside.any():
            print(
                f"| {low} to {high} | {probability[inside].mean():.2f} | {is_right[inside].mean():.2f} | "
                f"{inside.sum()} |"
            )
