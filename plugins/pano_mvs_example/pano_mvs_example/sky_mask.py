"""A mask of the sky, by its colour, its smoothness and its place."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pano_mvs.api import Context, Each, Panorama, Params, pad_panorama, stage
from pydantic import Field


class SkyParams(Params):
    """Settings of mask.sky."""

    min_brightness: int = Field(default=110, ge=0, le=255, description="the darkest sky there is, in grey levels")
    max_contrast: float = Field(default=12.0, gt=0, description="grey levels between neighbours in the sky, at most")
    min_elevation_deg: float = Field(default=0.0, ge=-90, le=90, description="nothing below is sky")
    margin_px: int = Field(default=1, ge=0, le=32, description="the sky is widened by this over its edges")


@stage("mask.sky")
def sky(image: Each[Panorama], params: SkyParams, ctx: Context) -> Panorama:
    """Ignore the sky: what is bright, not redder than blue, smooth, and joined to the zenith. For outdoor pictures.

    Indoors a white ceiling looks the same; leave the stage out there.
    """
    found = find_sky(image.load(), image.load_mask(), params)
    ctx.metric("sky", float(found.mean()))
    return image.with_mask(~found, ctx.scratch)


def find_sky(picture: NDArray[np.uint8], valid: NDArray[np.bool_], params: SkyParams) -> NDArray[np.bool_]:
    """Return the pixels of the sky, (H, W).

    Args:
        picture: (H, W, 3) RGB.
        valid: (H, W) pixels that are not masked; the masked ones neither are sky nor stand in its way.
        params: how bright, smooth and high up it is.
    """
    height = picture.shape[0]
    red, green, blue = np.moveaxis(picture.astype(np.float32), -1, 0)
    elevation_deg = 90 - (np.arange(height) + 0.5) * 180 / height
    like_sky = (blue >= params.min_brightness) & (blue >= red - 8) & (blue >= green - 8)
    like_sky &= _contrast(np.ascontiguousarray(picture[..., 1])) <= params.max_contrast
    like_sky &= (elevation_deg >= params.min_elevation_deg)[:, None]
    joined = _joined_to_zenith(like_sky | ~valid) & like_sky
    if params.margin_px:
        side = 2 * params.margin_px + 1
        padded = pad_panorama(joined.astype(np.uint8), params.margin_px)
        widened = cv2.dilate(padded, np.ones((side, side), np.uint8)) > 0
        joined = widened[params.margin_px : -params.margin_px, params.margin_px : -params.margin_px]
    result: NDArray[np.bool_] = joined & valid
    return result


def _contrast(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the largest difference to the four neighbours, over the seam and over the poles, (H, W)."""
    padded = pad_panorama(grey, 1).astype(np.float32)
    center = padded[1:-1, 1:-1]
    neighbours = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return np.asarray(np.max([np.abs(center - other) for other in neighbours], axis=0), np.float32)


def _joined_to_zenith(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return those of the pixels that a way over such pixels joins to the uppermost row, (H, W).

    The seam lies elsewhere every other time, so that ways over it are found, until nothing is added.
    """
    width = pixels.shape[1]
    reached = np.zeros_like(pixels)
    reached[0] = pixels[0]
    shift, idle = 0, 0
    while idle < 2:  # once for each place of the seam
        _, labels = cv2.connectedComponents(np.roll(pixels, shift, axis=1).astype(np.uint8), connectivity=4)
        touching = np.unique(labels[np.roll(reached, shift, axis=1)])
        wider = reached | np.roll(np.isin(labels, touching), -shift, axis=1)
        idle = idle + 1 if np.array_equal(wider, reached) else 0
        reached, shift = wider, width // 2 - shift
    return reached
