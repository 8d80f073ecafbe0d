"""Where the cameras stand, seen from above and from the side, with the links of the match graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import rotation_from_two_vectors

_WIDTH, _HEIGHT = 480, 360
_BORDER = 44
_MOST_LABELS, _MOST_LINKS = 40, 1500
_ABOVE, _SIDE = ((0, 1.0), (2, -1.0)), ((0, 1.0), (1, 1.0))


@dataclass(frozen=True)
class CameraMap:
    """One drawing, in the units of an SVG view box.

    Attributes:
        title: from where the cameras are seen.
        size_wh: of the view box.
        links: (x1, y1, x2, y2, strength from 0 to 1, what it says when pointed at).
        cameras: (x, y, name, where its label goes: x and y, or None).
        bar: (x, y, length, text) of the scale bar.
    """

    title: str
    size_wh: tuple[int, int]
    links: tuple[tuple[float, float, float, float, float, str], ...]
    cameras: tuple[tuple[float, float, str, tuple[float, float] | None], ...]
    bar: tuple[float, float, float, str]


def camera_maps(poses: Mapping[str, Any]) -> tuple[CameraMap, ...]:
    """Return the cameras from above and from the side; none where no centre is known.

    The direction up is `poses["up"]`, or −y (the camera frame of the first picture) where that is not given.
    """
    names = [str(name) for name in poses.get("registered") or []]
    centers = np.array(poses.get("centers") or [], dtype=np.float64).reshape(-1, 3)
    if not names or len(centers) != len(names) or not np.isfinite(centers).all():
        return ()
    level_from_world = rotation_from_two_vectors(poses.get("up") or (0, -1, 0), (0, -1, 0))
    centers = centers @ level_from_world.T
    links = _strongest(poses.get("links") or [], names)
    unit = "m" if poses.get("metric") else "units"
    labels = _labels(names)
    return tuple(
        _drawn(title, np.stack([sign * centers[:, axis] for axis, sign in axes], axis=-1), labels, links, unit)
        for title, axes in (("From above", _ABOVE), ("From the side", _SIDE))
    )


def _strongest(links: list[Any], names: list[str]) -> list[tuple[int, int, int]]:
    """Return the links between registered cameras as positions and inliers, weak ones first, so strong ones on top."""
    position = {name: idx for idx, name in enumerate(names)}
    known = [(position[a], position[b], int(n)) for a, b, n in links if a in position and b in position]
    return sorted(known, key=lambda link: link[2])[-_MOST_LINKS:]


def _labels(names: list[str]) -> list[str]:
    """Return names without folder and extension, where that leaves them distinct."""
    short = [PurePosixPath(name).stem for name in names]
    return short if len(set(short)) == len(short) else names


def _drawn(
    title: str, flat: NDArray[np.float64], labels: list[str], links: list[tuple[int, int, int]], unit: str
) -> CameraMap:
    """Return the drawing of cameras at (N, 2), x to the right and y down."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    extent = np.maximum(high - low, 1e-9 + 0.02 * float((high - low).max()))
    if not (high - low).any():
        extent = np.ones(2)
    scale = float(min((_WIDTH - 2 * _BORDER) / extent[0], (_HEIGHT - 2 * _BORDER) / extent[1]))
    height = int(np.clip(extent[1] * scale + 2 * _BORDER, 150, _HEIGHT))
    placed = np.round((flat - (low + high) / 2) * scale + (_WIDTH / 2, height / 2 - 6), 1)
    most = max((inliers for _, _, inliers in links), default=1) or 1
    drawn_links = tuple(
        (*map(float, (*placed[a], *placed[b])), inliers / most, f"{labels[a]} – {labels[b]}: {inliers} matches")
        for a, b, inliers in links
    )
    spots = _label_spots(placed, labels)
    cameras = tuple(
        (float(x), float(y), label, spot) for (x, y), label, spot in zip(placed, labels, spots, strict=True)
    )
    length = _round_length(110 / scale)
    bar = (14.0, height - 14.0, round(length * scale, 1), f"{length:g} {unit}")
    return CameraMap(title, (_WIDTH, height), drawn_links, cameras, bar)  # type: ignore[arg-type]


def _label_spots(placed: NDArray[np.float64], labels: list[str]) -> list[tuple[float, float] | None]:
    """Return where each label goes, below one another where cameras coincide; none where there are too many."""
    if len(labels) > _MOST_LABELS:
        return [None] * len(labels)
    taken: list[tuple[float, float]] = []
    for (x, y), label in zip(placed, labels, strict=True):
        spot = (float(x) + 9, float(y) - 7)
        half = 4.6 * len(label)
        if spot[0] + 2 * half > _WIDTH:
            spot = (float(x) - 9 - 1.8 * half, spot[1])
        while any(abs(spot[0] - other[0]) < 2 * half and abs(spot[1] - other[1]) < 15 for other in taken):
            spot = (spot[0], spot[1] + 15)
        taken.append(spot)
    return list(taken)


def _round_length(longest: float) -> float:
    """Return the greatest of 1, 2, 5 × 10ⁿ that is not longer."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(next(step * power for step in (5, 2, 1) if step * power <= longest * (1 + 1e-9)))
