"""Light and panoramas of a house of boxes, by tracing rays.

Light reaches a surface from the sky through windows, from lamps, and from other surfaces. It is computed once for each
house, on a lattice of 0.15 m on all surfaces, and smoothed, so that plain walls have the weak shading of real ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_from_pixel, ray_grid
from tools.benchmarks.poses.tours.materials import LAMP, MIRROR, PANE, SCREEN, albedo, outdoors

_TEXEL = 0.15
_CELL = 0.5
_RAYS = 96
_BOUNCES = 2
_FAR = 1e9
# Axes of the two coordinates on each face of a box: −x, +x, −y, +y, −z, +z.
_ACROSS = np.array([1, 1, 0, 0, 0, 0])
_UP = np.array([2, 2, 2, 2, 1, 1])


@dataclass(frozen=True)
class Boxes:
    """The surfaces of a house: boxes that are turned about the vertical.

    Attributes:
        frames: (N, 8) centre, half sizes, cosine and sine of the turn.
        kinds: (N, 2) material and seed of its pattern.
        colors: (N, 3) of the materials.
    """

    frames: FloatArray
    kinds: NDArray[np.int64]
    colors: FloatArray


@dataclass(frozen=True)
class Lit:
    """A house with its light.

    Attributes:
        boxes: its surfaces.
        starts: (X, Y) first entry of each cell of the ground plan in `members`, one more row at the end of each line.
        members: numbers of the boxes in the cells.
        low: (2,) corner of the ground plan.
        patches: (N, 6, 3) first entry in `light`, columns and rows of each face.
        light: (T) irradiance of all lattices.
        seed: seed of what is seen outside.
    """

    boxes: Boxes
    starts: NDArray[np.int64]
    members: NDArray[np.int64]
    low: FloatArray
    patches: NDArray[np.int64]
    light: FloatArray = field(repr=False)
    seed: int


def lit(boxes: Boxes, *, seed: int) -> Lit:
    """Return a house with its light."""
    starts, members, low = _ground_plan(boxes.frames)
    sizes = 2 * boxes.frames[:, 3:6]
    counts = np.stack([np.ceil(sizes[:, _ACROSS] / _TEXEL), np.ceil(sizes[:, _UP] / _TEXEL)], axis=2)
    counts = np.maximum(counts, 1).astype(np.int64)
    texels = counts.prod(axis=2)
    first = (np.cumsum(texels.ravel()) - texels.ravel()).reshape(texels.shape)
    patches = np.concatenate([first[..., None], counts], axis=2)
    light = np.zeros(int(texels.sum()))
    lamps = np.flatnonzero(boxes.kinds[:, 0] == LAMP)
    for _ in range(_BOUNCES):
        house = Lit(boxes, starts, members, low, patches, light, seed)
        new = np.zeros_like(light)
        _gather(_arrays(house), lamps, seed, np.random.default_rng(seed), new)
        light = _smoothed(new, patches.reshape(-1, 3))
    return Lit(boxes, starts, members, low, patches, light, seed)


def unlit(boxes: Boxes, *, seed: int) -> Lit:
    """Return a house without light, for `first_surfaces`."""
    starts, members, low = _ground_plan(boxes.frames)
    return Lit(boxes, starts, members, low, np.zeros((0, 6, 3), np.int64), np.zeros(0), seed)


def first_surfaces(
    house: Lit, cam_from_world: Rigid3, size_hw: tuple[int, int]
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Return the range at the centre of each pixel (H, W), the box that it shows, −1 outdoors, and the box's face."""
    rays = (ray_grid(size_hw) @ cam_from_world.rotation).reshape(-1, 3)
    distance, hit = np.empty(len(rays)), np.empty((len(rays), 2), np.int64)
    _trace_surfaces(_arrays(house), cam_from_world.center, rays, distance, hit)
    return distance.reshape(size_hw), hit[:, 0].reshape(size_hw), hit[:, 1].reshape(size_hw)


def panorama(
    house: Lit,
    cam_from_world: Rigid3,
    *,
    size_hw: tuple[int, int],
    rng: np.random.Generator,
    tripod: bool,
    fine: bool = True,
) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) uint8 RGB with the exposure, the noise and the tripod of a camera.

    Four rays are traced for each pixel, or two if it is not to be `fine`.
    """
    height, width = size_hw
    offsets = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])[:: 1 if fine else 3]
    image = np.zeros((height, width, 3))
    for offset in offsets:
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + offset
        rays = ray_from_pixel(pixels, size_hw) @ cam_from_world.rotation
        part = np.zeros((height * width, 3))
        _trace_rays(_arrays(house), cam_from_world.center, rays.reshape(-1, 3), 2 * np.pi / width, house.seed, part)
        image += part.reshape(image.shape) / len(offsets)
    image = np.maximum(image, 1e-3)  # strong patterns reach below zero
    exposure = 0.42 / np.exp(np.log(image.mean(axis=2)).mean()) * np.exp(0.1 * rng.normal())
    linear = image * exposure * np.exp(0.015 * rng.normal(size=3))
    levels = 255 * (1 - np.exp(-1.3 * linear)) ** (1 / 2.0)
    if tripod:
        rows = np.arange(height)[:, None] / height
        legs = np.abs((np.arange(width)[None] / width * 3) % 1 - 0.5) < 0.03
        levels[(rows > 0.955) | ((rows > 0.88) & legs)] *= 0.12
    noise = rng.normal(size=image.shape) * np.sqrt(0.6 + 0.012 * levels)
    return np.asarray(np.clip(np.rint(levels + noise), 0, 255), np.uint8)


def _arrays(house: Lit) -> tuple[NDArray[np.float64] | NDArray[np.int64], ...]:
    boxes = house.boxes
    grid = house.starts, house.members, house.low
    return boxes.frames, boxes.kinds, boxes.colors, *grid, house.patches, house.light


def _ground_plan(frames: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Return which boxes each cell of the ground plan meets."""
    cosine, sine = np.abs(frames[:, 6]), np.abs(frames[:, 7])
    reach = np.stack([cosine * frames[:, 3] + sine * frames[:, 4], sine * frames[:, 3] + cosine * frames[:, 4]], axis=1)
    lows, highs = frames[:, :2] - reach - 1e-6, frames[:, :2] + reach + 1e-6
    low = lows.min(axis=0)
    first, last = ((edges - low) // _CELL for edges in (lows, highs))
    shape = last.max(axis=0).astype(int) + 1
    cells: list[list[int]] = [[] for _ in range(shape[0] * shape[1])]
    for box, (start, end) in enumerate(zip(first.astype(int), last.astype(int), strict=True)):
        for x in range(start[0], end[0] + 1):
            for y in range(start[1], end[1] + 1):
                cells[x * shape[1] + y].append(box)
    ends = np.cumsum([len(cell) for cell in cells])
    starts = np.concatenate([[0], ends])
    table = np.stack([starts[:-1], starts[1:]], axis=1).reshape(shape[0], shape[1], 2)
    return table, np.array([box for cell in cells for box in cell], np.int64), low


def _smoothed(light: FloatArray, patches: NDArray[np.int64]) -> FloatArray:
    """Return light without the noise of sampling; what lies inside a box (NaN) takes that of its neighbours."""
    result = np.empty_like(light)
    for first, columns, rows in patches:
        part = slice(first, first + columns * rows)
        patch = light[part].reshape(rows, columns)
        seen = np.isfinite(patch).astype(float)
        total, weight = (
            cv2.GaussianBlur(values, (0, 0), 1.5, borderType=cv2.BORDER_REPLICATE)
            for values in (np.nan_to_num(patch), seen)
        )
        result[part] = (total / np.maximum(weight, 1e-6)).ravel()
    return result


@njit(nogil=True, error_model="numpy")
def _hit(arrays, origin, ray):  # type: ignore[no-untyped-def]
    """Return the distance, the box and the face that a ray meets first; the box is −1 outdoors."""
    frames, _, _, starts, members, low, _, _ = arrays
    best, box, face = _FAR, -1, 0
    columns, rows = starts.shape[0], starts.shape[1]
    # Enter the ground plan, then step from cell to cell.
    enter, leave = 0.0, _FAR
    for axis in range(2):
        limit = _CELL * starts.shape[axis]
        if abs(ray[axis]) > 1e-12:
            near, far = (low[axis] - origin[axis]) / ray[axis], (low[axis] + limit - origin[axis]) / ray[axis]
            enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
        elif not low[axis] <= origin[axis] <= low[axis] + limit:
            return best, box, face
    if enter >= leave:
        return best, box, face
    at = enter + 1e-9
    i = min(max(int((origin[0] + at * ray[0] - low[0]) / _CELL), 0), columns - 1)
    j = min(max(int((origin[1] + at * ray[1] - low[1]) / _CELL), 0), rows - 1)
    while 0 <= i < columns and 0 <= j < rows:
        for entry in range(starts[i, j, 0], starts[i, j, 1]):
            other = members[entry]
            distance, side = _meets(frames[other], origin, ray)
            if distance < best:
                best, box, face = distance, other, side
        next_x = next_y = _FAR
        if ray[0] > 1e-12:
            next_x = (low[0] + _CELL * (i + 1) - origin[0]) / ray[0]
        elif ray[0] < -1e-12:
            next_x = (low[0] + _CELL * i - origin[0]) / ray[0]
        if ray[1] > 1e-12:
            next_y = (low[1] + _CELL * (j + 1) - origin[1]) / ray[1]
        elif ray[1] < -1e-12:
            next_y = (low[1] + _CELL * j - origin[1]) / ray[1]
        if best <= min(next_x, next_y) or min(next_x, next_y) == _FAR:
            break
        if next_x < next_y:
            i += 1 if ray[0] > 0 else -1
        else:
            j += 1 if ray[1] > 0 else -1
    return best, box, face


@njit(nogil=True, error_model="numpy")
def _trace_surfaces(arrays, origin, rays, distance, hit):  # type: ignore[no-untyped-def]
    for idx in range(len(rays)):
        distance[idx], hit[idx, 0], hit[idx, 1] = _hit(arrays, origin, rays[idx])


@njit(nogil=True, error_model="numpy")
def _meets(frame, origin, ray):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray enters a box, and the face."""
    x, y, z = origin[0] - frame[0], origin[1] - frame[1], origin[2] - frame[2]
    cosine, sine = frame[6], frame[7]
    ox, oy = cosine * x + sine * y, cosine * y - sine * x
    dx, dy = cosine * ray[0] + sine * ray[1], cosine * ray[1] - sine * ray[0]
    near, far, face = 1e-5, _FAR, -1
    for axis in range(3):
        start = ox if axis == 0 else (oy if axis == 1 else z)
        along = dx if axis == 0 else (dy if axis == 1 else ray[2])
        half = frame[3 + axis]
        if abs(along) < 1e-12:
            if abs(start) > half:
                return _FAR, 0
            continue
        enter, leave = (-half - start) / along, (half - start) / along
        side = 2 * axis
        if enter > leave:
            enter, leave, side = leave, enter, side + 1
        if enter > near:
            near, face = enter, side
        far = min(far, leave)
    if face < 0 or near > far:
        return _FAR, 0
    return near, face


@njit(nogil=True, error_model="numpy")
def _is_inside(arrays, point):  # type: ignore[no-untyped-def]
    """Return whether a point lies inside a box."""
    frames, _, _, starts, members, low, _, _ = arrays
    i, j = int((point[0] - low[0]) / _CELL), int((point[1] - low[1]) / _CELL)
    if not (0 <= i < starts.shape[0] and 0 <= j < starts.shape[1]):
        return False
    for entry in range(starts[i, j, 0], starts[i, j, 1]):
        frame = frames[members[entry]]
        x, y = point[0] - frame[0], point[1] - frame[1]
        along, across = frame[6] * x + frame[7] * y, frame[6] * y - frame[7] * x
        if abs(along) < frame[3] and abs(across) < frame[4] and abs(point[2] - frame[2]) < frame[5]:
            return True
    return False


@njit(nogil=True, error_model="numpy")
def _on_face(frame, face, point):  # type: ignore[no-untyped-def]
    """Return the coordinates of a point on a face, and the size of the face, in metres."""
    x, y = point[0] - frame[0], point[1] - frame[1]
    cosine, sine = frame[6], frame[7]
    local = (cosine * x + sine * y + frame[3], cosine * y - sine * x + frame[4], point[2] - frame[2] + frame[5])
    if face < 2:
        return local[1], local[2], 2 * frame[4], 2 * frame[5]
    if face < 4:
        return local[0], local[2], 2 * frame[3], 2 * frame[5]
    return local[0], local[1], 2 * frame[3], 2 * frame[4]


@njit(nogil=True, error_model="numpy")
def _light_at(light, patch, u, v):  # type: ignore[no-untyped-def]
    """Return the light between the points of a lattice; u and v are shares of the face."""
    first, columns, rows = patch
    x = min(max(u * columns - 0.5, 0.0), columns - 1.0)
    y = min(max(v * rows - 0.5, 0.0), rows - 1.0)
    i, j = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
    a, b = x - i, y - j
    right, above = min(i + 1, columns - 1), min(j + 1, rows - 1)
    lower = light[first + j * columns + i] * (1 - a) + light[first + j * columns + right] * a
    upper = light[first + above * columns + i] * (1 - a) + light[first + above * columns + right] * a
    return lower * (1 - b) + upper * b


@njit(nogil=True, error_model="numpy")
def _normal(frame, face):  # type: ignore[no-untyped-def]
    sign = 1.0 if face % 2 else -1.0
    if face < 2:
        return np.array([sign * frame[6], sign * frame[7], 0.0])
    if face < 4:
        return np.array([-sign * frame[7], sign * frame[6], 0.0])
    return np.array([0.0, 0.0, sign])


@njit(nogil=True, error_model="numpy")
def _radiance(arrays, origin, ray, pixel, seed, color):  # type: ignore[no-untyped-def]
    """Write the light that arrives along a ray into color (3)."""
    frames, kinds, colors, _, _, _, patches, light = arrays
    weight, travelled = 1.0, 0.0
    start, way = origin.copy(), ray.copy()
    color[:] = 0.0
    for _ in range(8):
        distance, box, face = _hit(arrays, start, way)
        if box < 0:
            red, green, blue = outdoors(start, way, seed)
            color[0] += weight * red
            color[1] += weight * green
            color[2] += weight * blue
            return
        point = start + distance * way
        travelled += distance
        material = kinds[box, 0]
        if material == PANE:
            weight *= 0.93
            start = point + 1e-3 * way
            continue
        normal = _normal(frames[box], face)
        facing = abs(way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2])
        if material == LAMP:
            for channel in range(3):
                color[channel] += weight * 5.0 * colors[box, channel]
            return
        u, v, wide, high = _on_face(frames[box], face, point)
        footprint = pixel * travelled / max(facing, 0.08)
        red, green, blue = albedo(material, colors[box], (u, v), (wide, high), kinds[box, 1] + face, footprint)
        shade = weight * _light_at(light, patches[box, face], u / wide, v / high)
        mirrored = 0.85 if material == MIRROR else (0.08 + 0.5 * (1 - facing) ** 5 if material == SCREEN else 0.0)
        color[0] += (1 - mirrored) * shade * red
        color[1] += (1 - mirrored) * shade * green
        color[2] += (1 - mirrored) * shade * blue
        if mirrored * weight < 0.02:
            return
        weight *= mirrored
        along = way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]
        way = way - 2 * along * normal
        start = point + 1e-4 * way


@njit(nogil=True, error_model="numpy")
def _trace_rays(arrays, origin, rays, pixel, seed, out):  # type: ignore[no-untyped-def]
    for idx in range(len(rays)):
        _radiance(arrays, origin, rays[idx], pixel, seed, out[idx])


@njit(nogil=True, error_model="numpy")
def _gather(arrays, lamps, seed, rng, out):  # type: ignore[no-untyped-def]
    """Write the irradiance of all lattice points into out (T): from the sky, from surfaces, and from lamps."""
    frames, kinds, _, _, _, _, patches, _ = arrays
    color = np.empty(3)
    point, ray = np.empty(3), np.empty(3)
    for box in range(len(frames)):
        frame = frames[box]
        if kinds[box, 0] == PANE or kinds[box, 0] == LAMP:
            continue
        for face in range(6):
            first, columns, rows = patches[box, face]
            normal = _normal(frame, face)
            for texel in range(columns * rows):
                across = (texel % columns + rng.random()) / columns - 0.5
                up = (texel // columns + rng.random()) / rows - 0.5
                local = np.zeros(3)
                local[_ACROSS[face]] = 2 * across * frame[3 + _ACROSS[face]]
                local[_UP[face]] = 2 * up * frame[3 + _UP[face]]
                local[face // 2] = (frame[3 + face // 2] + 1e-4) * (1.0 if face % 2 else -1.0)
                point[0] = frame[0] + frame[6] * local[0] - frame[7] * local[1]
                point[1] = frame[1] + frame[7] * local[0] + frame[6] * local[1]
                point[2] = frame[2] + local[2]
                if _is_inside(arrays, point):
                    out[first + texel] = np.nan
                    continue
                total = 0.0
                turn = rng.random()
                for number in range(_RAYS):
                    _spread(number, turn, normal, ray)
                    _diffuse(arrays, point, ray, seed, color)
                    total += (color[0] + color[1] + color[2]) / (3.0 * _RAYS)
                out[first + texel] = total + _lamp_light(arrays, lamps, point, normal, rng)


@njit(nogil=True, error_model="numpy")
def _spread(number, turn, normal, ray):  # type: ignore[no-untyped-def]
    """Write one of _RAYS directions into ray (3), whose density falls as the cosine to the normal."""
    radius = np.sqrt((number + 0.5) / _RAYS)
    angle = 2.399963229728653 * number + 2 * np.pi * turn
    a, b, c = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius * radius)
    if abs(normal[2]) > 0.5:
        ray[0], ray[1], ray[2] = a, b, c * normal[2]
    else:
        ray[0], ray[1], ray[2] = c * normal[0] - a * normal[1], c * normal[1] + a * normal[0], b


@njit(nogil=True, error_model="numpy")
def _diffuse(arrays, origin, ray, seed, color):  # type: ignore[no-untyped-def]
    """Write the light of the surface or the sky that a ray meets into color (3), without patterns."""
    frames, kinds, colors, _, _, _, patches, light = arrays
    start = origin.copy()
    for _ in range(4):
        distance, box, face = _hit(arrays, start, ray)
        if box < 0:
            color[:] = 2.5 if ray[2] > 0.1 else 1.0
            return
        point = start + distance * ray
        if kinds[box, 0] != PANE:
            u, v, wide, high = _on_face(frames[box], face, point)
            shade = _light_at(light, patches[box, face], u / wide, v / high)
            for channel in range(3):
                color[channel] = shade * colors[box, channel]
            return
        start = point + 1e-3 * ray
    color[:] = 0.0


@njit(nogil=True, error_model="numpy")
def _lamp_light(arrays, lamps, point, normal, rng):  # type: ignore[no-untyped-def]
    """Return the light from the lamps that a point sees, each sampled at one place."""
    frames = arrays[0]
    total = 0.0
    ray = np.empty(3)
    for lamp in lamps:
        frame = frames[lamp]
        for axis in range(3):
            ray[axis] = frame[axis] + (2 * rng.random() - 1) * frame[3 + axis] - point[axis]
        distance = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
        if distance > 7.0:
            continue
        ray /= distance
        cosine = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
        if cosine > 0:
            _, box, _ = _hit(arrays, point, ray)
            if box == lamp:
                total += 1.2 * cosine / (0.3 + distance * distance)
    return total
