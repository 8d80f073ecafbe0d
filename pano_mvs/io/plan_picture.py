"""The picture of the plan of one storey, over an orthophoto of its floor."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.io.plan_drawings import COLORS, PlanDrawing, area_text

_PAPER = 255, 255, 255
_SUBPIXEL_BITS = 4


def strip_px(size_hw: tuple[int, int]) -> int:
    """Return the rows of the strip for the scale bar below a plan of a size."""
    return max(36, round(0.06 * max(size_hw)))


def draw_plan(photo: NDArray[np.uint8], known: NDArray[np.bool_], plan: PlanDrawing) -> NDArray[np.uint8]:
    """Return the picture of a plan (H + strip, W, 3) RGB: the strip below the plan has the scale bar.

    `photo`: (H, W, 3) RGB orthophoto of the box of the plan. `known`: (H, W) pixels that show something; others are
    white.
    """
    height, width = known.shape
    (left, _), (right, top) = plan.box
    pixel = (right - left) / width
    image = np.full((height + strip_px((height, width)), width, 3), _PAPER, np.uint8)
    image[:height][known] = photo[known]

    def pixels(xy: FloatArray) -> NDArray[np.int32]:
        # OpenCV's fixed-point numbers; pixels have their centres at whole numbers.
        places = np.stack([xy[..., 0] - left, top - xy[..., 1]], axis=-1) / pixel
        return np.asarray(np.rint((places - 0.5) * (1 << _SUBPIXEL_BITS)), np.int32)

    for solid in plan.solids:
        cv2.fillPoly(image, [pixels(solid)], COLORS["wall"], cv2.LINE_AA, _SUBPIXEL_BITS)
    thickness = max(2, round(width / 350))
    for kind, ends in [*(("wall", ends) for ends in plan.walls), *plan.openings]:
        start, end = pixels(ends).tolist()
        cv2.line(image, start, end, COLORS[kind], thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    radius = max(3, width // 150) << _SUBPIXEL_BITS
    for x, y in pixels(np.array(list(plan.cameras.values())).reshape(-1, 2)).tolist():
        cv2.circle(image, (x, y), radius, _PAPER, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(image, (x, y), int(0.7 * radius), COLORS["camera"], -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for room in plan.rooms if plan.is_metric else ():
        x, y = (pixels(np.array(room.label_xy)) >> _SUBPIXEL_BITS).tolist()
        text, size, font = area_text(room.area, superscript="2"), max(0.35, width / 1400), cv2.FONT_HERSHEY_SIMPLEX
        (wide, high), below = cv2.getTextSize(text, font, size, 1)
        x, y = x - wide // 2, y - 2 * (radius >> _SUBPIXEL_BITS)
        cv2.rectangle(image, (x - below, y - high - below), (x + wide + below, y + below), _PAPER, -1)
        cv2.putText(image, text, (x, y), font, size, COLORS["wall"], 1, cv2.LINE_AA)
    image[height:] = _PAPER
    _draw_bar(image[height:], plan, pixel)
    return image


def _draw_bar(strip: NDArray[np.uint8], plan: PlanDrawing, pixel: float) -> None:
    rows = strip.shape[0]
    left, right, middle = rows // 3, rows // 3 + round(plan.bar / pixel), rows // 2
    tick = max(3, rows // 8)
    thickness = max(1, rows // 24)
    for start, end in (
        ((left, middle), (right, middle)),
        ((left, middle - tick), (left, middle + tick)),
        ((right, middle - tick), (right, middle + tick)),
    ):
        cv2.line(strip, start, end, COLORS["wall"], thickness)
    size = rows / 60
    place, font = (right + rows // 4, middle + round(8 * size)), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(strip, f"{plan.bar:g} {plan.unit}", place, font, size, COLORS["wall"], thickness, cv2.LINE_AA)
