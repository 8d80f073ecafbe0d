"""Masks: stages that mask further areas of panoramas, which later stages then ignore."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.masks.areas import WIDTH, areas_of_color, reduced_to_width, share_of_sphere
from pano_mvs.algorithms.masks.expected_view import OtherView
from pano_mvs.algorithms.masks.moving import MAX_OTHERS, moving_pixels
from pano_mvs.algorithms.masks.people import people
from pano_mvs.algorithms.masks.static_content import MAX_VIEWS, static_content
from pano_mvs.api import (
    All,
    Context,
    Each,
    Near,
    One,
    Panorama,
    Params,
    Pose,
    RangeMap,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.scene.masking import nearest_pixels
from pano_mvs.scene.panorama import Camera, StaticMasks, camera_of


@params_from(areas_of_color)
class ColorParams(Params):
    """Settings of mask.color."""

    color: str = Field(default="#000000", pattern="^#[0-9a-fA-F]{6}$", description="colour to ignore, as #rrggbb")


@stage("mask.color")
def color(image: Each[Panorama], params: ColorParams, ctx: Context) -> Panorama:
    """Mask large areas of one colour, such as black areas left by a stitcher or a white disc over the tripod."""
    red, green, blue = bytes.fromhex(params.color[1:])
    found = areas_of_color(
        image.load(),
        (red, green, blue),
        **arguments_from(areas_of_color, params),
    )
    ctx.metric("masked", float(found.mean()))
    return image.with_mask(~found, ctx.scratch)


@params_from(static_content, own_last=True)
class StaticParams(Params):
    """Settings of masks.static."""

    enabled: bool = Field(default=True, description="false masks nothing")


@stage("masks.static", memory="160MB")
def static(images: All[Panorama], params: StaticParams, ctx: Context) -> StaticMasks:
    """Find what moves with the camera: the tripod, a rig, a selfie stick, the hand that holds it.

    It is what stays in place in the images while the world moves, so at least three images of a camera are needed, from
    different places. Images of the same size count as one camera. `masks.apply` masks it.
    """
    cameras: dict[Camera, list[str]] = {}
    for name in images if params.enabled else ():
        cameras.setdefault(camera_of(images[name]), []).append(name)
    found = {}
    for camera, names in cameras.items():
        chosen = [images[name] for name in _spread(names)]
        reduced = [reduced_to_width(panorama.load(), panorama.load_mask()) for panorama in chosen]
        content = static_content(
            [picture for picture, _ in reduced],
            [valid for _, valid in reduced],
            **arguments_from(static_content, params),
        )
        which = f"{len(names)} images of {camera[1]}×{camera[0]} px: " if len(cameras) > 1 else ""
        if content.reason:
            ctx.note(f"{which}nothing that moves with the camera was looked for: {content.reason}")
        elif content.pixels.any():
            found[camera] = content.pixels
            ctx.note(f"{which}{share_of_sphere(content.pixels):.1%} of the sphere moves with the camera and is masked")
    ctx.metric("images_masked", sum(len(cameras[camera]) for camera in found) / max(1, sum(map(len, cameras.values()))))
    masks = [_at_width(pixels) for pixels in found.values()]
    return StaticMasks(np.array(masks, np.uint8).reshape(-1, WIDTH // 2, WIDTH), tuple(found))


@stage("masks.apply")
def apply(image: Each[Panorama], static_masks: One[StaticMasks] | None, ctx: Context) -> Panorama:
    """Mask what `masks.static` has found; all later stages then ignore it."""
    pixels = None if static_masks is None else static_masks.of(image)
    ctx.metric("masked", 0.0 if pixels is None else float(pixels.mean()))
    return image if pixels is None or not pixels.any() else image.with_mask(~pixels, ctx.scratch)


@params_from(people, own_last=True)
class OperatorParams(Params):
    """Settings of masks.operator."""

    enabled: bool = Field(default=True, description="false masks nothing")


@stage("masks.operator", memory="250MB")
def operator(image: Each[Panorama], params: OperatorParams, ctx: Context) -> Panorama:
    """Mask people: the operator beside or below the camera, what they hold in front of them, and passers-by.

    People are found in each image by itself, by neural networks that run on the CPU. The image should be upright to
    within 20°.
    """
    if not params.enabled:
        return image
    found = people(image.load(), **arguments_from(people, params))
    ctx.metric("masked", share_of_sphere(found))
    return image.with_mask(~_resized(found, image.size_hw), ctx.scratch) if found.any() else image


@params_from(moving_pixels, own_last=True)
class MovingParams(Params):
    """Settings of masks.moving."""

    enabled: bool = Field(default=True, description="false masks nothing")


@stage("masks.moving", memory="400MB", every_image=True)
def moving(
    image: Each[Panorama],
    images: Near[Panorama],
    ranges: Near[RangeMap],
    poses: Near[Pose],
    params: MovingParams,
    ctx: Context,
) -> Panorama:
    """Mask what moves through the scene: people and vehicles that contradict the other views.

    Use it after filters.consistency. The stages after it, such as fusion and exports, ignore what it masks. Images
    without a pose or ranges, and those with fewer than two neighbours, stay as they are.
    """
    ctx.metric("masked", 0.0)
    if not params.enabled or not images or images[0].image != image.image:
        return image
    picture, valid = reduced_to_width(image.load(), image.load_mask())
    found = moving_pixels(
        picture,
        _sampled(ranges[0], (valid.shape[0], valid.shape[1])),
        [_other_view(images[idx], ranges[idx], poses[idx], of=poses[0]) for idx in _nearest(poses)],
        valid=valid,
        **arguments_from(moving_pixels, params),
    )
    ctx.metric("masked", share_of_sphere(found.pixels))
    if not found.pixels.any():
        return image
    return image.with_mask(~_resized(found.pixels, image.size_hw), ctx.scratch)


def _nearest(poses: Sequence[Pose]) -> list[int]:
    """Return the positions of the poses of the same group that are nearest to the first one, the nearest first."""
    own, *others = poses
    center = own.cam_from_world.center
    distances = [float(np.linalg.norm(pose.cam_from_world.center - center)) for pose in others]
    around = [idx for idx, pose in enumerate(others, start=1) if pose.group == own.group]
    return sorted(around, key=lambda idx: distances[idx - 1])[:MAX_OTHERS]


def _other_view(image: Panorama, range_map: RangeMap, pose: Pose, *, of: Pose) -> OtherView:
    picture, valid = reduced_to_width(image.load(), image.load_mask())
    sampled = _sampled(range_map, (valid.shape[0], valid.shape[1]))
    return OtherView(picture, valid, sampled, pose.cam_from_world @ of.cam_from_world.inverse())


def _sampled(range_map: RangeMap, size_hw: tuple[int, int]) -> RangeMap:
    """Return some pixels of a range map, (h, w)."""
    return RangeMap(nearest_pixels(range_map.range, size_hw), nearest_pixels(range_map.confidence, size_hw))


def _resized(pixels: NDArray[np.bool_], size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask of the full sphere at another size, with interpolated edges."""
    shares = cv2.resize(pixels.astype(np.float32), size_hw[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(shares >= 0.5)


def _spread(names: list[str]) -> list[str]:
    """Return at most `MAX_VIEWS` names, evenly spread."""
    return [names[idx] for idx in np.unique(np.rint(np.linspace(0, len(names) - 1, MAX_VIEWS)).astype(int))]


def _at_width(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask at `WIDTH` columns."""
    rows, columns = (
        np.arange(size) * side // size for size, side in zip((WIDTH // 2, WIDTH), pixels.shape, strict=True)
    )
    return np.asarray(pixels[rows[:, None], columns])
