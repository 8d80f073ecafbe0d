"""Draw people into panoramas of places with known ranges: operators under the tripod and beside it, and passers-by.

A person consists of rounded limbs that blend into one another, with clothes of several materials. Everything is in
world coordinates, so that panoramas of several cameras show the same person, and hidden parts are hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.testing.room import noise

Point = tuple[float, float, float]

# x to the right of the person, y up from the ground, z to the front; radii at both ends; what it wears there.
Limb = tuple[Point, Point, float, float, str]

_STEPS, _HIT = 40, 0.004
_BLEND = 0.02
_SUN = np.array([0.45, -0.75, 0.48]) / np.linalg.norm([0.45, -0.75, 0.48])

# Colours of materials in [0, 1], and the strength of their texture.
_MATERIALS: dict[str, tuple[Point, float]] = {
    "black": ((0.06, 0.06, 0.07), 0.35),
    "jeans": ((0.16, 0.22, 0.36), 0.25),
    "grey": ((0.42, 0.42, 0.44), 0.15),
    "beige": ((0.60, 0.53, 0.42), 0.12),
    "red": ((0.62, 0.12, 0.12), 0.15),
    "orange": ((0.98, 0.42, 0.08), 0.10),
    "yellow": ((0.80, 0.92, 0.15), 0.10),
    "skin": ((0.80, 0.58, 0.47), 0.05),
    "hair": ((0.13, 0.09, 0.06), 0.40),
    "fair": ((0.62, 0.48, 0.28), 0.30),
    "white": ((0.88, 0.88, 0.86), 0.06),
}
# Jacket, trousers, top of the head, backpack.
OUTFITS: dict[str, tuple[str, str, str, str]] = {
    "black": ("black", "black", "hair", ""),
    "vest": ("orange", "black", "white", ""),
    "yellow": ("yellow", "jeans", "hair", ""),
    "jacket": ("grey", "jeans", "fair", "black"),
    "shirt": ("red", "beige", "hair", ""),
}


@dataclass(frozen=True)
class Person:
    """A person in the world.

    Attributes:
        limbs: in world coordinates, y is down.
        seed: of the textures.
    """

    limbs: tuple[Limb, ...]
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Drawn:
    """A panorama with people.

    Attributes:
        picture: (H, W, 3) uint8.
        people: (H, W), the pixels that show them.
        shadow: (H, W), the pixels that show their shadow.
        ranges: (H, W) float32, with those of the people.
    """

    picture: Picture
    people: Mask
    shadow: Mask
    ranges: NDArray[np.float32]


def _both(limb: Limb) -> list[Limb]:
    """Return a limb and its mirror image."""
    (ax, ay, az), (bx, by, bz), first, second, worn = limb
    return [limb, ((-ax, ay, az), (-bx, by, bz), first, second, worn)]


def _limbs(pose: str) -> list[Limb]:
    """Return the limbs of a person in a pose, wearing "jacket", "trousers", "cap", "skin", "shoe" and "pack"."""
    hip, neck, head, elbow, hand, knee, foot, toe = _JOINTS[pose]
    shoulder = (0.17, neck[1] - 0.07, neck[2] - 0.02)
    back = tuple(np.array(neck) * 0.55 + np.array(hip) * 0.45 + (0, 0.06, -0.2))
    return [
        ((0.0, hip[1], hip[2]), (0.0, neck[1] - 0.1, neck[2]), 0.15, 0.17, "jacket"),
        ((0.0, neck[1], neck[2]), head, 0.06, 0.095, "skin"),
        (head, (head[0], head[1] + 0.035, head[2] - 0.02), 0.10, 0.105, "cap"),
        ((back[0], back[1] + 0.05, back[2]), (back[0], back[1] - 0.2, back[2] - 0.05), 0.13, 0.13, "pack"),
        *_both((shoulder, elbow, 0.075, 0.055, "jacket")),
        *_both((elbow, hand, 0.055, 0.04, "jacket")),
        *_both((hand, (hand[0], hand[1], hand[2] + 0.05), 0.045, 0.04, "skin")),
        *_both(((0.1, hip[1], hip[2]), knee, 0.10, 0.07, "trousers")),
        *_both((knee, foot, 0.07, 0.05, "trousers")),
        *_both((foot, toe, 0.05, 0.045, "shoe")),
    ]


# Hip, neck, head, elbow, hand, knee, foot, toe of a person 1.75 m tall.
_JOINTS: dict[str, tuple[Point, ...]] = {
    "crouching": ((0.1, 0.32, -0.2), (0, 0.78, 0.1), (0, 0.9, 0.2), (0.3, 0.45, 0.3), (0.12, 0.35, 0.5),
                  (0.2, 0.48, 0.25), (0.14, 0.08, -0.08), (0.16, 0.05, 0.12)),
    "bent": ((0.1, 0.45, -0.35), (0, 0.62, 0.18), (0, 0.58, 0.36), (0.28, 0.32, 0.3), (0.2, 0.06, 0.42),
             (0.15, 0.07, -0.05), (0.13, 0.06, -0.5), (0.13, 0.05, -0.68)),
    "squatting": ((0.1, 0.25, -0.1), (0, 0.75, -0.02), (0, 0.93, 0.02), (0.36, 0.5, 0.2), (0.2, 0.5, 0.45),
                  (0.26, 0.45, 0.32), (0.16, 0.08, 0.05), (0.2, 0.05, 0.25)),
    "sitting": ((0.1, 0.14, -0.2), (0, 0.62, -0.25), (0, 0.8, -0.2), (0.3, 0.35, -0.1), (0.18, 0.25, 0.18),
                (0.16, 0.32, 0.25), (0.15, 0.08, 0.65), (0.17, 0.14, 0.75)),
    "standing": ((0.1, 0.9, 0.0), (0, 1.48, 0.0), (0, 1.64, 0.03), (0.28, 1.12, -0.03), (0.26, 0.88, 0.12),
                 (0.12, 0.5, 0.03), (0.12, 0.08, -0.02), (0.13, 0.04, 0.16)),
    "walking": ((0.1, 0.9, 0.0), (0, 1.47, 0.03), (0, 1.63, 0.06), (0.27, 1.12, -0.1), (0.26, 0.92, 0.05),
                (0.11, 0.5, 0.15), (0.11, 0.1, -0.1), (0.12, 0.05, 0.1)),
}  # fmt: skip  # a line for each pose
POSES = tuple(_JOINTS)


def person(
    pose: str, outfit: str, *, at_xz: tuple[float, float], ground_y: float, heading: float, seed: int = 0
) -> Person:
    """Return a person who stands or crouches on the ground.

    Args:
        pose: one of `POSES`.
        outfit: one of `OUTFITS`.
        at_xz: position on the ground, in world coordinates.
        ground_y: height of the ground, in world coordinates (y is down).
        heading: azimuth of the person's front, in radians.
        seed: of the clothes' texture, and of small changes of the pose.
    """
    jacket, trousers, cap, pack = OUTFITS[outfit]
    worn = {"jacket": jacket, "trousers": trousers, "cap": cap, "skin": "skin", "shoe": "black", "pack": pack}
    rng = np.random.default_rng(seed)
    cos, sin = np.cos(heading), np.sin(heading)

    def placed(point: Point) -> Point:
        x, y, z = np.array(point) + rng.normal(0, 0.012, 3)
        return float(at_xz[0] + cos * x + sin * z), float(ground_y - y), float(at_xz[1] - sin * x + cos * z)

    limbs = [
        (placed(first), placed(second), ra, rb, worn[part])
        for first, second, ra, rb, part in _limbs(pose)
        if worn[part]
    ]
    return Person(tuple(limbs), seed)


def draw_people(
    picture: Picture,
    ranges: NDArray[np.float32],
    pose: Rigid3,
    *,
    people: Sequence[Person],
    shadows: bool = True,
    shadow_level: float = 0.45,
) -> Drawn:
    """Draw people into a panorama.

    Args:
        picture: (H, W, 3) uint8 RGB.
        ranges: (H, W), not finite where there is no surface.
        pose: cam_from_world.
        people: in the world.
        shadows: whether they cast shadows from a sun.
        shadow_level: brightness of shadows.
    """
    size_hw = (ranges.shape[0], ranges.shape[1])
    rays = (ray_grid(size_hw) @ pose.rotation).reshape(-1, 3)
    surface = np.where(np.isfinite(ranges), ranges, np.inf).reshape(-1).astype(np.float64)
    colors = picture.reshape(-1, 3).astype(np.float64)
    nearest, shadow = surface.copy(), np.zeros(len(rays), np.bool_)
    if shadows:
        shadow = _shadow(people, pose.center, rays, surface=surface)
        colors[shadow] *= shadow_level * np.array([0.95, 1.0, 1.07])
    shown = np.zeros(len(rays), np.bool_)
    for body in people:
        rows, distances = _traced(body, pose.center, rays, limit=nearest)
        points = pose.center + distances[:, None] * rays[rows]
        colors[rows] = _shaded(body, points)
        nearest[rows] = distances
        shown[rows] = True
    height, width = size_hw
    return Drawn(
        np.clip(np.rint(colors), 0, 255).astype(np.uint8).reshape(height, width, 3),
        shown.reshape(size_hw),
        (shadow & ~shown).reshape(size_hw),
        np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32).reshape(size_hw),
    )


def _bounds(body: Person) -> tuple[FloatArray, float]:
    ends = np.array([end for limb in body.limbs for end in limb[:2]])
    center = (ends.min(axis=0) + ends.max(axis=0)) / 2
    return center, float(np.linalg.norm(ends - center, axis=1).max()) + 0.25


def _traced(
    body: Person, origin: FloatArray, rays: FloatArray, *, limit: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the rays that meet a body before a distance, and where, by sphere tracing."""
    center, radius = _bounds(body)
    along = rays @ (center - origin)
    across = np.sqrt(np.maximum(np.sum((center - origin) ** 2) - along**2, 0))
    rows = np.flatnonzero((across < radius) & (along > -radius))
    distance = np.maximum(along[rows] - np.sqrt(np.maximum(radius**2 - across[rows] ** 2, 0)), 0.02)
    most = np.minimum(along[rows] + radius, limit[rows])
    hit = np.zeros(len(rows), np.bool_)
    active = np.arange(len(rows))
    for _ in range(_STEPS):
        step = _signed_distance(body, origin + distance[active, None] * rays[rows[active]])
        hit[active[step < _HIT]] = True
        distance[active] += np.maximum(step, 0)
        active = active[(step >= _HIT) & (distance[active] < most[active])]
        if not len(active):
            break
    hit &= distance < most
    return rows[hit], distance[hit]


def _limb_distances(body: Person, points: FloatArray) -> FloatArray:
    """Return the distance (L, N) of points from each limb."""
    found = []
    for first, second, ra, rb, _ in body.limbs:
        a, axis = np.array(first), np.array(second) - first
        share = np.clip((points - a) @ axis / max(float(axis @ axis), 1e-9), 0, 1)
        found.append(np.linalg.norm(points - a - share[:, None] * axis, axis=1) - ra - (rb - ra) * share)
    return np.array(found)


def _signed_distance(body: Person, points: FloatArray) -> FloatArray:
    distances = _limb_distances(body, points)
    least = distances.min(axis=0)
    return np.asarray(least - _BLEND * np.log(np.exp(-(distances - least) / _BLEND).sum(axis=0)))


def _shaded(body: Person, points: FloatArray) -> FloatArray:
    """Return the colours (N, 3) of points on a body, with folds, and reflecting bands on vests."""
    offsets = 0.004 * np.eye(3)
    folds = 0.012 * noise(points, cells=((0.012, 1.0), (0.004, 0.4)), seed=body.seed + 3)
    values = [_signed_distance(body, points + offset) for offset in offsets]
    bumps = [
        0.012 * noise(points + offset, cells=((0.012, 1.0), (0.004, 0.4)), seed=body.seed + 3) for offset in offsets
    ]
    here = _signed_distance(body, points)
    normals = np.stack([v - here + 0.35 * (b - folds) for v, b in zip(values, bumps, strict=True)], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    light = 0.45 + 0.25 * np.clip(-normals[:, 1], -1, 1) + 0.55 * np.clip(normals @ _SUN, 0, 1)
    worn = _limb_distances(body, points).argmin(axis=0)
    grain = noise(points, cells=((0.003, 1.0), (0.02, 0.5)), seed=body.seed + 11)
    colors = np.zeros_like(points)
    for idx, (first, second, *_, material) in enumerate(body.limbs):
        on = worn == idx
        color, strength = _MATERIALS[material]
        colors[on] = np.array(color) * (1 + strength * np.tanh(grain[on]))[:, None]
        if material in ("orange", "yellow"):
            axis = np.array(second) - first
            along = (points[on] - first) @ axis / max(float(np.linalg.norm(axis)), 1e-9)
            band = np.abs(along % 0.22 - 0.11) < 0.025
            colors[np.flatnonzero(on)[band]] = (0.78, 0.80, 0.82)
    return np.asarray(255 * np.clip(colors * light[:, None], 0, 1))


def _shadow(people: Sequence[Person], origin: FloatArray, rays: FloatArray, *, surface: FloatArray) -> Mask:
    """Return the rays that meet a surface which people keep from the sun."""
    shadow = np.zeros(len(rays), np.bool_)
    seen = np.flatnonzero(np.isfinite(surface))
    points = origin + surface[seen, None] * rays[seen]
    for body in people:
        center, radius = _bounds(body)
        towards = center - points
        along = towards @ _SUN
        across = np.linalg.norm(towards - along[:, None] * _SUN, axis=1)
        near = np.flatnonzero((across < radius) & (along > -radius))
        for start in range(0, len(near), 1 << 15):
            some = near[start : start + (1 << 15)]
            shadow[seen[some]] |= _lit_through(body, points[some])
    return shadow


def _lit_through(body: Person, points: FloatArray) -> Mask:
    """Return which points (N, 3) a body keeps from the sun."""
    at = points + 0.03 * _SUN
    hit = np.zeros(len(points), np.bool_)
    active = np.arange(len(points))
    for _ in range(_STEPS):
        step = _signed_distance(body, at[active])
        hit[active[step < _HIT]] = True
        at[active] += np.maximum(step, _HIT)[:, None] * _SUN
        active = active[(step >= _HIT) & (step < 3)]
        if not len(active):
            break
    return hit
