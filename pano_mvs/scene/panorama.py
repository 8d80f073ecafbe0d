"""An equirectangular image, by reference to its file."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import LensRig
from pano_mvs.scene.image_file import (
    MASK_BYTES_PER_PIXEL,
    MAX_PIXELS,
    decode_image,
    decoding_bytes_per_pixel,
    write_png,
)
from pano_mvs.scene.masking import decode_mask, inside_crop, painted_over, placed_mask, placed_picture, same_shape
from pano_mvs.scene.record import Axis, FilePart, Parts, Record, require, require_array


class RecentPictures:
    """Decoded pictures by what they depend on; the least recently used are dropped beyond a number of bytes."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._pictures: OrderedDict[Hashable, NDArray[np.uint8]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable) -> NDArray[np.uint8] | None:
        """Return a copy of a picture, or None if it is not there."""
        with self._lock:
            picture = self._pictures.get(key)
            if picture is None:
                return None
            self._pictures.move_to_end(key)
        return picture.copy()

    def put(self, key: Hashable, picture: NDArray[np.uint8]) -> None:
        """Keep a copy of a picture."""
        if 4 * picture.nbytes > self._limit_bytes:
            return
        with self._lock:
            self._pictures[key] = picture.copy()
            self._pictures.move_to_end(key)
            while sum(kept.nbytes for kept in self._pictures.values()) > self._limit_bytes:
                self._pictures.popitem(last=False)


class SceneLink(NamedTuple):
    """A link to another panorama, such as a hotspot of a virtual tour."""

    name: str  # of the panorama to which it leads
    # where it stands in the picture, in degrees to the right of its middle and above the horizon; None if not known
    direction_deg: tuple[float, float] | None = None

    @classmethod
    def from_value(cls, value: Any) -> Self:
        """Return the link from a name, or from JSON of a link."""
        if isinstance(value, str):
            return cls(value)
        name, direction_deg = value
        return cls(name, None if direction_deg is None else tuple(direction_deg))


_OF_SOME = frozenset({"rig", "first_lens", "second_lens", "links"})
_RECENT = RecentPictures(limit_bytes=48 << 20)


@dataclass(frozen=True, eq=False)
class Panorama(Record):
    """An equirectangular image, decoded on demand.

    Attributes:
        image: the image file.
        size_hw: (height, width) of the full sphere at working resolution, width = 2 × height.
        source_size_hw: (height, width) of the full sphere at the file's own resolution.
        crop_ltwh: (left, top, width, height) in source pixels of the part of the sphere in the file (GPano's
            CroppedArea), or None for all of it.
        mask_file: an image, 0 where the panorama is ignored, or None. It covers the same part as the image, at any
            resolution, or the whole sphere, depending on its aspect ratio. For a crop twice as wide as high, only a
            mask of source_size_hw covers the sphere.
        nadir_deg: pixels closer than this to straight down are ignored (tripod, operator).
        zenith_deg: the same around straight up.
        up_in_cam: the direction away from gravity by the camera's sensors, unit (3,), or None.
        heading_deg: compass heading of the image centre, or None.
        position_lla: (latitude deg, longitude deg, altitude m) from GPS, or None.
        rig: the lenses from whose pictures the panorama was stitched, or None if they are not known.
        first_lens: the file with the picture of the rig's first lens, or None without a rig.
        second_lens: the file of the second lens; None if `first_lens` shows both side by side.
        links: to other panoramas that are known to lie nearby, such as those to which a scene of a tour leads.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE
    kind_version: ClassVar[int] = 2  # since masked pixels are filled

    image: FilePart
    size_hw: tuple[int, int]
    source_size_hw: tuple[int, int]
    crop_ltwh: tuple[int, int, int, int] | None = None
    mask_file: FilePart | None = None
    nadir_deg: float = 0.0
    zenith_deg: float = 0.0
    up_in_cam: tuple[float, float, float] | None = None
    heading_deg: float | None = None
    position_lla: tuple[float, float, float] | None = None
    rig: LensRig | None = None
    first_lens: FilePart | None = None
    second_lens: FilePart | None = None
    links: tuple[SceneLink, ...] = ()

    def __post_init__(self) -> None:
        """Convert links that are given by their names, or stored as lists."""
        object.__setattr__(self, "links", tuple(map(SceneLink.from_value, self.links)))

    def to_parts(self) -> Parts:
        """Return the panorama with its rig as JSON; nothing is stored about a rig or links that it does not have."""
        parts = dict(super().to_parts())
        meta = parts["meta"]
        assert isinstance(meta, dict)
        meta = {key: value for key, value in meta.items() if key not in _OF_SOME}
        meta |= {} if self.rig is None else {"rig": self.rig.to_values()}
        return parts | {"meta": meta | ({"links": self.links} if self.links else {})}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the panorama from the result of `to_parts`."""
        panorama = super().from_parts(parts)
        meta = parts["meta"]
        assert isinstance(meta, dict)
        rig = meta.get("rig")
        return panorama if rig is None else replace(panorama, rig=LensRig.from_values(rig))

    def check(self) -> None:
        """Raise ContractError unless the sizes are those of full spheres."""
        height, width = self.size_hw
        require(width == 2 * height and height > 0, self, f"size_hw {self.size_hw} is not that of a full sphere")

    def at_width(self, width: int) -> Panorama:
        """Return the panorama at another working resolution: at most that of its file, and a multiple of four."""
        if width != self.size_hw[1]:
            width = min(width, self.source_size_hw[1]) // 4 * 4
        return self if width == self.size_hw[1] else replace(self, size_hw=(width // 2, width))

    def loading_bytes(self) -> int:
        """Return the peak memory of `load` and `load_mask`, which decode the files at their own resolution."""
        _, _, width, height = self.covers_ltwh
        masked = 0
        if self.mask_file is not None:  # a stage's mask, which is in the store, has the working resolution
            masked = height * width if self.mask_file.external else self.size_hw[0] * self.size_hw[1]
        return max(height * width * decoding_bytes_per_pixel(self.image.path), masked * MASK_BYTES_PER_PIXEL)

    def load(self) -> NDArray[np.uint8]:
        """Return the image at working resolution, (H, W, 3) uint8 RGB, with masked pixels filled.

        Masked pixels and pixels outside of a crop have the colours around them (`painted_over`), so that no result
        depends on masked content.

        Raises:
            ChangedFileError: if the file or its mask has changed since the run listed it.
            InputError: if one of them is missing, truncated, not an image, or has another size.
        """
        valid = self.load_mask()
        return self._recent(None if valid.all() else valid)

    def load_unmasked(self) -> NDArray[np.uint8]:
        """Return the image with its masked pixels, (H, W, 3) uint8 RGB, for display; black outside of a crop."""
        return self._recent(None)

    def _recent(self, valid: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
        """Return the image, painted over where it is not valid."""
        data = self.image.read_bytes()
        shown = None if valid is None else digest_from_bytes(valid.tobytes())
        key = digest_from_bytes(data), self.size_hw, self.source_size_hw, self.crop_ltwh, shown
        picture = _RECENT.get(key)
        if picture is None:
            picture = self._decoded(data) if valid is None else painted_over(self._recent(None), valid)
            _RECENT.put(key, picture)
        return picture

    def _decoded(self, data: bytes) -> NDArray[np.uint8]:
        height, width = self.source_size_hw  # which the source accepted, possibly above the usual limit
        image = decode_image(self.image.path, data, max_pixels=max(MAX_PIXELS, height * width))
        _, _, width, height = self.covers_ltwh
        if (not same_shape(image.shape[:2], (height, width))) or (
            self.crop_ltwh is None and image.shape[:2] != self.source_size_hw
        ):
            raise InputError(
                f"{self.image.path}: {image.shape[1]}×{image.shape[0]} px, but it had {width}×{height} "
                "when it was listed. Run again to use it as it is now"
            )
        if self.crop_ltwh is None:
            return _resized(image, self.size_hw)
        return placed_picture(image, self.size_hw, of=self.crop_ltwh, whole_hw=self.source_size_hw)

    def load_mask(self) -> NDArray[np.bool_]:
        """Return the valid pixels at working resolution, (H, W) bool; every stage ignores the others.

        A pixel is valid if no part of it is masked, near the nadir or the zenith, or outside of the crop.

        Raises:
            ChangedFileError: if the mask file has changed since the run listed it.
            InputError: if it is missing, not an image, or has the shape of neither the sphere nor the crop.
        """
        height = self.size_hw[0]
        valid = np.zeros(self.size_hw, np.bool_)
        valid[inside_crop(self.size_hw, self.covers_ltwh, self.source_size_hw)] = True
        nearest_deg = np.arange(height + 1) * 180 / height  # of the rows' upper edges, from straight up
        valid[(nearest_deg[:-1] < self.zenith_deg) | (nearest_deg[1:] > 180 - self.nadir_deg)] = False
        if self.mask_file is not None:
            mask = decode_mask(self.mask_file.path, self.mask_file.read_bytes())
            valid &= self._placed(mask, f"{self.mask_file.path}: the mask")
        return valid

    def with_mask(self, valid: NDArray[np.bool_], folder: Path) -> Panorama:
        """Return the panorama with further masked pixels.

        Args:
            valid: (H, W) bool, or of another size that a mask file may have; False is ignored.
            folder: the folder of the new mask file: `ctx.scratch` of a stage.
        """
        further = np.asarray(valid, np.bool_)
        keep = self.load_mask() & (
            further if further.shape == self.size_hw else self._placed(further, "a stage's mask")
        )
        if self.crop_ltwh is not None and same_shape(self.size_hw, (self.crop_ltwh[3], self.crop_ltwh[2])):
            height, width = whole = (
                self.source_size_hw
            )  # at working resolution, its size could be confused with that of the crop
            keep = placed_mask(keep, whole, of=(0, 0, width, height), whole_hw=whole)
        path = folder / f"{self.image.path.stem}.mask.png"
        write_png(path, np.where(keep, np.uint8(255), np.uint8(0)))
        return replace(self, mask_file=FilePart(path))

    @property
    def covers_ltwh(self) -> tuple[int, int, int, int]:
        """The part of the sphere in the file: (left, top, width, height) in source pixels."""
        height, width = self.source_size_hw
        return self.crop_ltwh or (0, 0, width, height)

    def _placed(self, mask: NDArray[np.bool_], what: str) -> NDArray[np.bool_]:
        """Return a mask at working resolution; its size or shape shows whether it covers the sphere or the crop."""
        height, width = self.source_size_hw
        sphere, crop = (0, 0, width, height), self.covers_ltwh
        size = mask.shape[0], mask.shape[1]
        if size == self.source_size_hw:
            covered = sphere
        elif same_shape(size, (crop[3], crop[2])):
            covered = crop
        elif same_shape(size, self.source_size_hw):
            covered = sphere
        else:
            of = f"{width}×{height} px" if crop == sphere else f"a part of {crop[2]}×{crop[3]} px of {width}×{height}"
            raise InputError(
                f"{what} has {size[1]}×{size[0]} px, which is the shape neither of the full sphere nor of the image "
                f"({self.image.path.name}, {of}). Draw it over the image itself; its resolution does not matter"
            )
        return placed_mask(mask, self.size_hw, of=covered, whole_hw=self.source_size_hw)


def _resized(image: NDArray[np.uint8], size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    if image.shape[:2] == size_hw:
        return image
    resized: NDArray[np.uint8] = cv2.resize(image, size_hw[::-1], interpolation=cv2.INTER_AREA)
    return resized


Camera: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class StaticMasks(Record):
    """The content that stays in place in the images while the world moves: tripod, rig, stick, hand."""

    axis: ClassVar[Axis | None] = Axis.ONE

    # (G, h, 2 h) uint8, one mask for each camera in which something was found: 1 where it is
    pixels: NDArray[np.uint8]
    cameras: tuple[Camera, ...] = ()  # the camera of each mask, see `camera_of`

    def check(self) -> None:
        """Raise ContractError unless there is one mask of a full sphere for each camera."""
        pixels = require_array(self, "pixels", dtype=np.uint8, shape=(len(self.cameras), None, None))
        require(pixels.shape[2] == 2 * pixels.shape[1], self, "the masks are not of full spheres")
        require(not pixels.size or int(pixels.max()) <= 1, self, "pixels are 0 or 1")

    def of(self, panorama: Panorama) -> NDArray[np.bool_] | None:
        """Return the pixels of a panorama that move with its camera, (H, W) bool at working resolution, or None."""
        camera = camera_of(panorama)
        if camera not in self.cameras:
            return None
        height, width = panorama.size_hw
        mask = self.pixels[self.cameras.index(camera)].astype(np.float32)
        wrapped = np.concatenate([mask[:, -1:], mask, mask[:, :1]], axis=1)  # so that the seam is interpolated as well
        columns = (np.arange(width, dtype=np.float32) + 0.5) * mask.shape[1] / width + 0.5
        rows = (np.arange(height, dtype=np.float32) + 0.5) * mask.shape[0] / height - 0.5
        at_xy = np.meshgrid(columns, np.clip(rows, 0, mask.shape[0] - 1))
        return np.asarray(cv2.remap(wrapped, at_xy[0], at_xy[1], cv2.INTER_LINEAR) >= 0.5)


def camera_of(panorama: Panorama) -> Camera:
    """Return what identifies a camera: the sizes of the sphere in its file and here, and the part that it covers."""
    return (*panorama.source_size_hw, *panorama.covers_ltwh, *panorama.size_hw)
