"""Mask people in orange vests. To use your own neural network, replace `find_vests`."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.api import Context, Each, Panorama, Params, stage


class VestsParams(Params):
    """Settings of mask.vests."""

    margin_deg: float = Field(
        default=4.0, ge=0, le=30, description="widen each vest by this angle, to cover its wearer"
    )


@stage("mask.vests")
def vests(image: Each[Panorama], params: VestsParams, ctx: Context) -> Panorama:
    """Mask everybody who wears an orange vest."""
    found = find_vests(over_the_seam(image.load()))
    found = cv2.dilate(found.astype(np.uint8), disc(params.margin_deg, found.shape[0])) > 0
    quarter = found.shape[1] // 6
    ctx.metric("ignored", float(found.mean()))
    return image.with_mask(~found[:, quarter:-quarter], ctx.scratch)


def over_the_seam(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image that continues beyond the seam by a quarter of its width on either side.

    Networks do not know that the image wraps around: a person on the seam would look like two halves.
    """
    quarter = picture.shape[1] // 4
    return np.concatenate([picture[:, -quarter:], picture, picture[:, :quarter]], axis=1)


def find_vests(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the orange pixels, (H, W)."""
    hue, saturation, brightness = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV))
    found: NDArray[np.bool_] = (hue > 5) & (hue < 18) & (saturation > 180) & (brightness > 120)
    return found


def disc(radius_deg: float, height: int) -> NDArray[np.uint8]:
    """Return a disc with a radius given in degrees on the equator."""
    radius = round(radius_deg * height / 180)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
