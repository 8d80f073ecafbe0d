"""Where on the sphere an image lies, by its GPano metadata."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.metadata import GPano

_WRITE = "Write the fields that are missing into it with a program such as ExifTool"
_NO_TOP = (
    "no CroppedAreaTopPixels in their GPano metadata: as much is taken to be cut off at the top as at the bottom. If "
    "that is not so, all of their directions are wrong; then write this field into them"
)
_NO_LEFT = (
    "no CroppedAreaLeftPixels in their GPano metadata: as much is taken to be cut off on the left as on the right. "
    "This only turns each camera, and their headings are not used"
)


@dataclass(frozen=True)
class Placement:
    """The part of the sphere that an image shows."""

    sphere_hw: tuple[int, int]  # (height, width) of the full sphere; see `PictureInfo.size_hw`
    crop_ltwh: tuple[int, int, int, int] | None = None  # the part in the image, in its pixels, or None for all of it
    knows_left: bool = True  # whether it is known where on the horizon the part begins
    warnings: tuple[str, ...] = ()  # see `PictureInfo`
    traits: tuple[str, ...] = ()  # likewise


def placed(path: Path, size_hw: tuple[int, int], gpano: GPano | None) -> Placement:
    """Return where an image lies on the sphere.

    What its metadata do not state is only taken from what they and the size of the image imply. Without any, it is the
    full sphere if it is twice as wide as high. If nothing but the upper edge is missing, as much was cut off at the top
    as at the bottom, which the traits state.

    Args:
        path: of the image, for messages.
        size_hw: (height, width) of the image.
        gpano: its metadata, or None.

    Raises:
        InputError: if it is not a full sphere and no metadata place it on one, or if they are incomplete or contradict
            the image or each other.
    """
    gpano = gpano or GPano()
    left, top, *_ = gpano.crop_ltwh
    full_hw = _sphere(gpano)
    if full_hw is None:
        return _full_sphere(path, size_hw, gpano)
    (crop_width, crop_height), warnings = _crop_size(path, size_hw, gpano, full_hw=full_hw)
    if (crop_height, crop_width) == full_hw:
        if left or top:
            warnings = (
                *warnings,
                "its GPano metadata state where a part begins, but show all of the sphere; that was ignored",
            )
        return Placement(_checked(path, size_hw), warnings=warnings)
    height, width = _checked(path, full_hw)
    traits: tuple[str, ...] = ()
    knows_left = left is not None or crop_width == width
    if left is None:
        left = (width - crop_width) // 2
        traits += () if knows_left else (_NO_LEFT,)
    if top is None:
        if crop_width < width and crop_height < height:
            raise InputError(
                f"{path}: its GPano metadata state a part of {crop_width}×{crop_height} px of a sphere of "
                f"{width}×{height}, but not its upper edge, CroppedAreaTopPixels. {_WRITE}"
            )
        top = (height - crop_height) // 2
        traits += () if crop_height == height else (_NO_TOP,)
    if left + crop_width > width or top + crop_height > height:
        raise InputError(
            f"{path}: its GPano cropped area of {crop_width}×{crop_height} px at ({left}, {top}) does not lie within "
            f"the sphere of {width}×{height} px. Correct the metadata, or remove them if it shows the full sphere"
        )
    return Placement((height, width), (left, top, crop_width, crop_height), knows_left, warnings, traits)


def _sphere(gpano: GPano) -> tuple[int, int] | None:
    """Return the stated size of the sphere, whose width is twice its height, or None."""
    height, width = gpano.full_size_hw
    if height is None:
        return None if width is None else (width // 2, width)
    return height, 2 * height if width is None else width


def _full_sphere(path: Path, size_hw: tuple[int, int], gpano: GPano) -> Placement:
    """Return the placement of an image whose metadata do not state the size of the sphere."""
    height, width = size_hw
    left, top, crop_width, crop_height = gpano.crop_ltwh
    states_part = left or top or (crop_width is not None and crop_height is not None and crop_width != 2 * crop_height)
    if states_part:
        raise InputError(
            f"{path}: its GPano metadata state a cropped area, but not the size of the full sphere, "
            f"FullPanoWidthPixels and FullPanoHeightPixels. {_WRITE}"
        )
    if width != 2 * height:
        raise InputError(
            f"{path}: {width}×{height} px is not a full sphere (the width must be twice the height) and no GPano "
            "metadata place it on one. Remove it, export it again as a full equirectangular panorama, set `stereo` "
            "(top_bottom, left_right) if it shows both eyes, or, if it is "
            "cropped, write the GPano FullPano and CroppedArea fields into it"
        )
    return Placement(size_hw)


def _crop_size(
    path: Path, size_hw: tuple[int, int], gpano: GPano, *, full_hw: tuple[int, int]
) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Return the width and height of the part of the sphere, in pixels of the sphere, and warnings."""
    height, width = size_hw
    left, top, crop_width, crop_height = gpano.crop_ltwh
    if crop_width is None and crop_height is None:
        if width == 2 * height and not (left or top):  # a full sphere, which may have been resized
            return full_hw[::-1], ()
        return (width, height), ("its GPano metadata do not state the size of the part; that of the image is used",)
    if crop_height is None:
        assert crop_width is not None
        crop_height = (crop_width * height + width // 2) // width
    elif crop_width is None:
        crop_width = (crop_height * width + height // 2) // height
    if (crop_height, crop_width) == size_hw:
        return (crop_width, crop_height), ()
    if abs(width * crop_height - height * crop_width) > max(width, height, crop_width, crop_height):
        raise InputError(
            f"{path}: {width}×{height} px, but its GPano metadata state {crop_width}×{crop_height}. It was cut "
            "after it was taken: restore the original, or remove the metadata"
        )
    warning = (
        f"resized from {crop_width}×{crop_height} to {width}×{height} px after it was taken; its GPano "
        "fields count the original's pixels"
    )
    return (crop_width, crop_height), (warning,)


def _checked(path: Path, sphere_hw: tuple[int, int]) -> tuple[int, int]:
    height, width = sphere_hw
    if width != 2 * height:
        raise InputError(
            f"{path}: its GPano metadata say that the full sphere is {width}×{height} px, but the width must be twice "
            "the height. Correct the metadata, or remove them"
        )
    return sphere_hw
