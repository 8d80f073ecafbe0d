"""A tiny synthetic capture with possible results of all stages, as input of contract tests."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM
from pano_mvs.core.paths import exists
from pano_mvs.geometry import Rigid3, pixel_from_ray, roll_panorama
from pano_mvs.scene import (
    Ceilings,
    Features,
    FilePart,
    GlobalDescriptor,
    House,
    Pairs,
    Panorama,
    PlacedBy,
    PointCloud,
    Pose,
    Poses,
    RangeMap,
    Record,
    RoomLines,
    RoomOutline,
    Scores,
    TwoView,
    Views,
    WeakImage,
)
from pano_mvs.scene.files import FaceFiles
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.panorama import StaticMasks, camera_of
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.rooms import CEILINGS, OUTLINE_AZIMUTHS
from pano_mvs.scene.surfaces import Structure, SurfaceSamples, TrackedPoints
from pano_mvs.testing.room import capture_poses, default_room, range_along, render

Frozen = TypeVar("Frozen", bound=Record)

_POINTS = 240
_NOISE_RAD = 2e-4
_METRES_PER_DEGREE = 111_320.0
_folders: list[TemporaryDirectory[str]] = []


@dataclass(frozen=True)
class Variant:
    """A variant of the tiny capture."""

    size_hw: tuple[int, int] = (32, 64)
    rolled: int = 0  # number of columns by which all images are rolled to the right, with rotated cameras
    masked: bool = False  # whether the tripod and a patch across the seam are masked in every image
    scribbled: bool = False  # whether masked pixels show noise instead of the room
    cropped: bool = False  # whether the files lack the uppermost and lowest eighth of the sphere
    mixed: bool = False  # whether every second image has half as many rows
    # whether there is nothing to see: everything is masked, and earlier stages found nothing
    blank: bool = False


@dataclass(frozen=True, eq=False)
class TinyCapture:
    """Some views of a synthetic room."""

    folder: Path  # folder with images/ and truth/poses.json
    variant: Variant
    names: tuple[str, ...]
    poses: tuple[Rigid3, ...]  # cam_from_world of each image
    # the images, equal to the files unless these are cropped or scribbled
    pictures: tuple[NDArray[np.uint8], ...]
    ranges: tuple[NDArray[np.float32], ...]  # true ranges, (H, W) float32

    @functools.cached_property
    def images(self) -> dict[str, Panorama]:
        """The panoramas, with GPS positions and sensor directions."""
        return {name: self._panorama(idx) for idx, name in enumerate(self.names)}

    @functools.cached_property
    def items(self) -> Mapping[type[Record], Mapping[Any, Record]]:
        """Items of each kind by image, or by pair."""
        pairs = self.whole(Pairs)
        return {
            Panorama: self.images,
            Pose: {name: Pose(pose) for name, pose in zip(self.names, self.poses, strict=True)},
            Features: {name: self._features(idx) for idx, name in enumerate(self.names)},
            GlobalDescriptor: {name: self._descriptor(idx) for idx, name in enumerate(self.names)},
            RangeMap: {name: self._range_map(idx) for idx, name in enumerate(self.names)},
            FaceFiles: {name: FaceFiles({}, size_px=12) for name in self.names},
            SurfaceSamples: {name: self._samples(idx) for idx, name in enumerate(self.names)},
            WeakImage: {name: WeakImage(wanted=True) for name in self.names},
            RoomLines: dict.fromkeys(self.names, self._lines()),
            RoomOutline: dict.fromkeys(self.names, self._outline()),
            TwoView: {pair: self._two_view(*pair) for pair in pairs.pairs},
        }

    @functools.cached_property
    def wholes(self) -> Mapping[type[Record], Record]:
        """The single value of each kind."""
        count = len(self.names)
        pairs = tuple((self.names[i], self.names[j]) for i in range(count) for j in range(i + 1, count))
        others = {name: tuple(other for other in self.names if other != name) for name in self.names}
        pixels = np.zeros((8, 16), np.uint8)
        pixels[5:, 2:6] = pixels[7:] = 1
        pixels = np.roll(pixels, 16 * self.variant.rolled // self.variant.size_hw[1], axis=1)
        camera = camera_of(self.images[self.names[0]])
        poses = self._poses_with_points()
        return {
            Pairs: Pairs(pairs),
            Views: Views(others),
            Poses: self._poses_with_points(),
            PointCloud: self._cloud(),
            TrackedPoints: frozen(
                TrackedPoints(
                    names=poses.names,
                    points_in_world=poses.points_in_world,
                    colors_rgb=poses.point_colors_rgb,
                    errors_rad=poses.point_errors_rad,
                    track_point_idx=poses.track_point_idx,
                    track_image_idx=poses.track_image_idx,
                    track_bearings=poses.track_bearings,
                )
            ),
            StaticMasks: frozen(StaticMasks(pixels[None], (camera,))),
            Structure: self._structure(),
            Scores: Scores({"registered": 1.0}, {}),
            House: self._house(),
            Ceilings: frozen(Ceilings(np.exp(-((CEILINGS / 0.7 - 1) ** 2)).astype(np.float32))),
            Photographs: self._photographs(),
        }

    def _lines(self) -> RoomLines:
        """Return lines that show a ceiling, .7 camera heights above the cameras."""
        return frozen(RoomLines(np.eye(3), 0.0, np.exp(-((CEILINGS / 0.7 - 1) ** 2)).astype(np.float32)))

    def _outline(self) -> RoomOutline:
        """Return a square room, whose walls are 1.5 camera heights away."""
        azimuths = np.radians(np.arange(OUTLINE_AZIMUTHS))
        distances = 1.5 / np.maximum(np.abs(np.sin(azimuths)), np.abs(np.cos(azimuths)))
        right = np.full(OUTLINE_AZIMUTHS, 0.9, np.float32)
        return frozen(RoomOutline(np.eye(3), 0.0, 0.7, distances.astype(np.float32), right))

    def _house(self) -> House:
        """Return the house of the capture, whose last camera only links place."""
        count = len(self.names)
        single = np.arange(count) == count - 1
        return frozen(
            House(
                names=self.names,
                rotations=np.array([pose.rotation for pose in self.poses]),
                translations=np.array([pose.translation for pose in self.poses]),
                parts=single.astype(np.int32),
                groups=np.where(single, -1, 0).astype(np.int32),
                scales=np.ones(count),
                placed_by=tuple(str(PlacedBy.LINKS if one else PlacedBy.MATCHES) for one in single),
                center_stds=np.where(single, 0.5, 0.0),
                turn_stds_rad=np.where(single, 0.1, 0.0),
                links=tuple((self.names[0],) if one else () for one in single),
                camera_height=1.5,
            )
        )

    def each(self, kind: type[Frozen]) -> dict[Any, Frozen]:
        """Return the items of a kind."""
        return {key: item for key, item in self.items[kind].items() if isinstance(item, kind)}

    def whole(self, kind: type[Frozen]) -> Frozen:
        """Return the single value of a kind."""
        value = self.wholes[kind]
        assert isinstance(value, kind)
        return value

    @functools.cached_property
    def points_in_world(self) -> NDArray[np.float64]:
        """Points on the room's surfaces, (P, 3); each is assumed to be visible from everywhere."""
        rng = np.random.default_rng(5)
        rays = rng.normal(size=(_POINTS, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        origin = self.poses[0].center
        return np.asarray(origin + rays * range_along(default_room(), origin, rays)[:, None])

    def bearings(self, idx: int) -> NDArray[np.float64]:
        """Return the noisy unit rays, (P, 3), along which a camera sees the points."""
        rays = self.poses[idx].apply(self.points_in_world)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        noisy = rays + np.random.default_rng([6, idx]).normal(0, _NOISE_RAD, rays.shape)
        return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))

    def _panorama(self, idx: int) -> Panorama:
        height, width = self.pictures[idx].shape[:2]
        images, mask = self.folder / "images", self.folder / f"mask{idx}.png"
        center = self.poses[idx].center
        up = self.poses[idx].rotation @ (0.0, -1.0, 0.0)
        return Panorama(
            image=FilePart(images / self.names[idx], external=True),
            size_hw=(height, width),
            source_size_hw=(height, width),
            crop_ltwh=(0, height // 8, width, height - 2 * (height // 8)) if self.variant.cropped else None,
            mask_file=FilePart(mask, external=True) if exists(mask) else None,
            up_in_cam=(float(up[0]), float(up[1]), float(up[2])),
            position_lla=(center[2] / _METRES_PER_DEGREE, center[0] / _METRES_PER_DEGREE, 50.0 - center[1]),
        )

    def _features(self, idx: int) -> Features:
        height, width = self.pictures[idx].shape[:2]
        count = 0 if self.variant.blank else _POINTS
        bearings = self.bearings(idx)[:count]
        pixels = np.floor(pixel_from_ray(bearings, (height, width))).astype(int)
        descriptors = np.random.default_rng(7).normal(size=(_POINTS, 128))[:count]
        descriptors *= DESCRIPTOR_NORM / np.linalg.norm(descriptors, axis=1, keepdims=True)
        return frozen(
            Features(
                bearings=bearings,
                descriptors=np.rint(descriptors).astype(np.float32),
                sizes_rad=np.full(count, 0.05, np.float32),
                scores=np.linspace(1, 0.1, _POINTS, dtype=np.float32)[:count],
                colors_rgb=self.pictures[idx][pixels[:, 1] % height, pixels[:, 0] % width],
                metric="l2",
                size_hw=(height, width),
                learned=count,
            )
        )

    def _descriptor(self, idx: int) -> GlobalDescriptor:
        vector = np.random.default_rng([8, idx]).normal(size=16).astype(np.float32)
        return frozen(GlobalDescriptor(np.zeros_like(vector) if self.variant.blank else vector))

    def _range_map(self, idx: int) -> RangeMap:
        """Return the true ranges with noise, a hole and some outliers; masked pixels have none."""
        height, width = self.ranges[idx].shape
        draws = np.roll(np.random.default_rng([9, idx]).random((2, height, width)), self.variant.rolled, axis=2)
        ranges = self.ranges[idx] * (1 + 0.004 * (draws[0] - 0.5)).astype(np.float32)
        ranges = np.where(draws[1] < 0.02, 0.6 * ranges, ranges)
        hole = np.zeros((height, width), np.bool_)
        hole[height // 3 : height // 2, width // 8 : width // 4] = True
        keep = ~np.roll(hole, self.variant.rolled, axis=1) & self.images[self.names[idx]].load_mask()
        confidence = np.where(draws[1] < 0.3, np.uint8(90), np.uint8(200))
        return frozen(
            RangeMap(np.where(keep, ranges, np.nan).astype(np.float32), np.where(keep, confidence, 0).astype(np.uint8))
        )

    def _two_view(self, first: str, second: str) -> TwoView:
        if self.variant.blank:
            return frozen(TwoView.failed("nothing to see"))
        one, other = self.names.index(first), self.names.index(second)
        relative = self.poses[other] @ self.poses[one].inverse()
        same = np.arange(_POINTS, dtype=np.int32)
        return frozen(
            TwoView(
                matches_idx=np.stack([same, same], axis=-1),
                rotation=relative.rotation,
                direction=relative.translation / np.linalg.norm(relative.translation),
                residuals_rad=np.full(_POINTS, _NOISE_RAD, np.float32),
                geometry="general",
                candidates=_POINTS,
                parallax_deg=10.0,
                rotation_std_deg=0.02,
                direction_std_deg=0.05,
            )
        )

    def _poses_with_points(self) -> Poses:
        poses = dict(zip(self.names, self.poses, strict=True))
        bare = Poses.without_points(poses, frame="the room's", scale="the room's", metric=False)
        if self.variant.blank:
            return frozen(bare)
        count = len(self.names)
        return frozen(
            Poses(
                names=bare.names,
                rotations=bare.rotations,
                translations=bare.translations,
                points_in_world=self.points_in_world,
                point_colors_rgb=np.full((_POINTS, 3), 128, np.uint8),
                point_errors_rad=np.full(_POINTS, _NOISE_RAD, np.float32),
                track_point_idx=np.tile(np.arange(_POINTS, dtype=np.int32), count),
                track_image_idx=np.repeat(np.arange(count, dtype=np.int32), _POINTS),
                track_bearings=np.concatenate([self.bearings(idx) for idx in range(count)]),
                rejected={},
            )
        )

    def _samples(self, idx: int) -> SurfaceSamples:
        """Return the points as seen by one view, as if each had been found in its range map."""
        count = 0 if self.variant.blank else _POINTS
        distances = np.linalg.norm(self.poses[idx].apply(self.points_in_world), axis=1)[:count]
        colors, sure = np.full((count, 3), 128, np.uint8), np.full(count, 200, np.uint8)
        return frozen(SurfaceSamples(self.bearings(idx)[:count], distances.astype(np.float32), colors, sure))

    def _photographs(self) -> Photographs:
        """Return a photograph that was taken from the place of the first image."""
        pose = self.poses[0]
        return frozen(
            Photographs(
                names=("phone/1.png",),
                sizes_hw=np.array([[30, 40]], np.int32),
                focals_px=np.array([35.0]),
                radials=np.array([-0.05]),
                rotations=pose.rotation[None].copy(),
                translations=pose.translation[None].copy(),
                inliers=np.array([50], np.int32),
                errors_px=np.array([0.5], np.float32),
                pictures=(FilePart(self.folder / "phone" / "1.png"),),
            )
        )

    def _structure(self) -> Structure:
        """Return the floor, and one wall with a mirror."""
        normals, offsets = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([-1.3, -3.0])
        mirror = np.array([[(3.0, -0.6, 0.5), (3.0, -0.6, -0.5), (3.0, 0.4, -0.5), (3.0, 0.4, 0.5)]])
        groups = np.zeros(2, np.int32)
        return frozen(Structure(normals, offsets, np.full(2, 0.004), groups, mirror, groups[:1].copy()))

    def _cloud(self) -> PointCloud:
        points = self.points_in_world[: 0 if self.variant.blank else None]
        normals = -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
        counts = np.full(len(points), 2, np.uint8)
        colors = np.full((len(points), 3), 128, np.uint8)
        return frozen(PointCloud(points.astype(np.float32), normals.astype(np.float32), colors, counts))


def frozen(record: Frozen) -> Frozen:
    """Return a record with read-only arrays, as the store returns them."""
    for value in vars(record).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return record


@functools.cache
def tiny_capture(variant: Variant = Variant()) -> TinyCapture:
    """Return the capture of a variant; it is rendered once, into a folder that is deleted when the process ends."""
    _folders.append(TemporaryDirectory(prefix="pano-mvs-tiny-"))
    folder = Path(_folders[-1].name)
    (folder / "images").mkdir()
    (folder / "truth").mkdir()
    (folder / "phone").mkdir()
    write_png(folder / "phone" / "1.png", np.random.default_rng(11).integers(0, 256, (30, 40, 3), np.uint8))
    names, poses, pictures, ranges = [], [], [], []
    for idx, straight in enumerate(capture_poses(4, spread=0.4)):
        size_hw = _half(variant.size_hw) if variant.mixed and idx % 2 else variant.size_hw
        picture, true_range = render(default_room(), straight, size_hw, supersample=1)
        columns = variant.rolled * size_hw[1] // variant.size_hw[1]
        picture, turn = roll_panorama(picture, columns)
        names.append(f"{idx:03d}.png")
        poses.append(Rigid3(turn, np.zeros(3)) @ straight)
        pictures.append(picture)
        ranges.append(np.roll(true_range, columns, axis=1))
        _write_picture(folder, variant, idx, picture=picture)
    views = [
        {"image": f"images/{name}", "R": pose.rotation.tolist(), "t": pose.translation.tolist()}
        for name, pose in zip(names, poses, strict=True)
    ]
    size = {"width": variant.size_hw[1], "height": variant.size_hw[0], "metric": True}
    (folder / "truth" / "poses.json").write_text(json.dumps(size | {"views": views}), encoding="utf-8")
    depth = {name.removesuffix(".png"): values for name, values in zip(names, ranges, strict=True)}
    np.savez(folder / "truth" / "depth.npz", **depth)  # type: ignore[arg-type]  # names are ours
    return TinyCapture(folder, variant, tuple(names), tuple(poses), tuple(pictures), tuple(ranges))


def _write_picture(folder: Path, variant: Variant, idx: int, *, picture: NDArray[np.uint8]) -> None:
    height, width = picture.shape[:2]
    edge = height // 8 if variant.cropped else 0
    keep = np.full((height, width), 0 if variant.blank else 255, np.uint8)
    keep[-height // 5 :] = 0
    keep[height // 4 : height // 2, : width // 10] = 0
    keep[height // 4 : height // 2, -width // 10 :] = 0
    keep = np.roll(keep, variant.rolled, axis=1)
    if variant.masked or variant.blank:
        write_png(folder / f"mask{idx}.png", keep)
    if variant.scribbled:
        noise = np.random.default_rng([10, idx]).integers(0, 256, picture.shape, np.uint8)
        picture = np.where(keep[..., None] > 0, picture, noise)
    write_png(folder / "images" / f"{idx:03d}.png", picture[edge : height - edge])


def _half(size_hw: tuple[int, int]) -> tuple[int, int]:
    return max(4, size_hw[0] // 2), max(8, size_hw[0] // 2 * 2)
