"""The rooms in which panoramas were taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.engine.workflows.yaml_text import parse_yaml
from pano_mvs.geometry import Rigid3, pixel_from_ray, pixel_solid_angle, ray_grid
from pano_mvs.scene import FilePart

_SAMPLED_HW = (16, 32)
_TOLERANCE = 0.1
_MIN_SHARED = 0.5


@dataclass(frozen=True, eq=False)
class Sight:
    """What a panorama saw."""

    cam_from_page: Rigid3  # its pose
    ranges: NDArray[np.float32]  # (H, W) float32; NaN where there is none


def given_rooms(given: Mapping[str, Sequence[str]] | str | Path) -> dict[str, tuple[str, ...]]:
    """Return the names of panoramas, or patterns of them, of each room.

    Args:
        given: these; or a YAML file with the name of each room, and a list such as `[IMG_0001.jpg, kitchen/*]`.

    Raises:
        InputError: if the file cannot be read, or what is given has another layout.
    """
    rooms: object = given
    if isinstance(given, (str, Path)):
        try:
            rooms = parse_yaml(FilePart(Path(given)).read_bytes().decode("utf-8", "replace"), str(given)).plain()
        except WorkflowError as error:
            raise InputError(f"--rooms: {error}") from error
    option = f"--rooms {given}" if isinstance(given, (str, Path)) else "rooms"
    if not isinstance(rooms, Mapping) or not all(isinstance(names, (list, tuple)) for names in rooms.values()):
        raise InputError(f"{option}: give rooms with lists of panoramas, such as `Kitchen: [IMG_0001.jpg]`")
    for room, names in rooms.items():
        for name in names:
            if not isinstance(name, str):
                raise InputError(
                    f"{option}: {room}: {name!r} is not text. Give names of panoramas, in quotes if they look like "
                    "something else"
                )
    return {str(room): tuple(names) for room, names in rooms.items()}


def unmatched(names: Sequence[str], given: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the given names and patterns that match no panorama.

    Args:
        names: paths of the panoramas relative to the capture.
        given: names or patterns of panoramas by room.
    """
    wanted = [each for patterns in given.values() for each in patterns]
    return [each for each in wanted if not any(_matches(name, each) for name in names)]


def _matches(name: str, pattern: str) -> bool:
    return name == pattern or fnmatchcase(name, pattern)


def rooms_of(
    names: Sequence[str], sights: Mapping[str, Sight], given: Mapping[str, Sequence[str]] | None = None
) -> list[str]:
    """Return the room of each panorama; "" where it is not known.

    Rooms are taken from the first of these that distinguishes them: what the user gave; the folders of the panoramas;
    their names, if these are words without digits; and which panoramas see mostly the same surfaces.

    Args:
        names: paths of the panoramas relative to the capture.
        sights: what they saw, by their names; those without ranges may be missing.
        given: names or patterns of panoramas by room.
    """
    if given is not None:
        return [
            next((room for room, patterns in given.items() if any(_matches(name, each) for each in patterns)), "")
            for name in names
        ]
    paths = [PurePosixPath(name) for name in names]
    for told in ([path.parent.name for path in paths], [path.stem.replace("_", " ") for path in paths]):
        if len(set(told)) > 1 and all(name and not any(sign.isdigit() for sign in name) for name in told):
            return told
    known = [name for name in names if name in sights]
    numbers = dict(zip(known, rooms_by_sight([sights[name] for name in known]), strict=True))
    if len(set(numbers.values())) < 2:
        return [""] * len(names)
    return [f"Room {numbers[name]}" if name in numbers else "" for name in names]


def rooms_by_sight(sights: Sequence[Sight]) -> list[int]:
    """Return a number of the room of each panorama, from 1 in the order of their first panoramas.

    Panoramas belong to one room if on average each sees more than half of what the other one sees, in terms of solid
    angle: through a door one sees less. More than 400 panoramas are not divided.
    """
    if not 1 < len(sights) <= 400:  # all pairs are compared
        return [1] * len(sights)
    shared = np.array([[_share(first, second) for second in sights] for first in sights])
    apart = 1 - np.minimum(shared, shared.T)
    np.fill_diagonal(apart, 0)
    labels = fcluster(linkage(squareform(apart), "average"), 1 - _MIN_SHARED, "distance").tolist()
    order = {label: number for number, label in enumerate(dict.fromkeys(labels), 1)}
    return [order[label] for label in labels]


def _share(first: Sight, second: Sight) -> float:
    """Return the part of what the first panorama saw, in solid angle, that the second one saw as well."""
    rays = ray_grid(_SAMPLED_HW)
    ranges = _at(first.ranges, rays)
    points = first.cam_from_page.inverse().apply(ranges[..., None] * rays)
    there = second.cam_from_page.apply(np.nan_to_num(points))
    distances = np.linalg.norm(there, axis=-1)
    known = np.isfinite(ranges) & (distances > 0)
    seen = known & (_at(second.ranges, np.where(known[..., None], there, 1.0)) > (1 - _TOLERANCE) * distances)
    weights = np.broadcast_to(pixel_solid_angle(_SAMPLED_HW)[:, None], known.shape)
    return float(weights[seen].sum() / max(weights[known].sum(), 1e-12))


def _at(ranges: NDArray[np.float32], rays: FloatArray) -> NDArray[np.float32]:
    """Return the ranges of the pixels in which rays arrive."""
    height, width = ranges.shape
    columns, rows = np.moveaxis(np.floor(pixel_from_ray(rays, (height, width))).astype(int), -1, 0)
    return np.asarray(ranges[rows.clip(0, height - 1), columns % width], np.float32)
