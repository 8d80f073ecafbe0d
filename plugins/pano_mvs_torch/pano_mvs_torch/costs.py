"""The costs of a band of rows, many virtual ranges at a time; in whole numbers, so that no order of sums matters."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from pano_mvs.api import SweepInput, pad_panorama
from pano_mvs.api.sweep import (
    GREY_WEIGHT,
    MAX_COLOR_COST,
    MAX_GRADIENT_COST,
    ZNCC_NOISE_VARIANCE,
    WindowBands,
    census_weight,
    column_offsets,
)
from torch import Tensor


class BandCost:
    """What the rows `first` to `last` of the reference cost.

    Attributes:
        halo: rows on either side of the band that a lookup has to cover too.
    """

    def __init__(self, work: SweepInput, first: int, last: int, device: torch.device) -> None:
        settings = work.settings
        height, width = work.reference.shape[:2]
        self.compare_radius, self.box_radius = settings.compare_radius, settings.box_radius
        self.census_weight = census_weight(self.compare_radius)
        self.halo = self.compare_radius + self.box_radius
        spherical = settings.spherical_window
        columns = column_offsets((height, width), self.compare_radius, spherical=spherical)
        compared = _mirrored(np.arange(first - self.box_radius, last + self.box_radius), height)
        self.windows = WindowBands(self.compare_radius, columns[compared], width)
        boxes = column_offsets((height, width), self.box_radius, spherical=spherical)[first:last]
        self.boxes = WindowBands(self.box_radius, boxes, width)
        around = pad_panorama(work.reference, self.halo)[first : last + 2 * self.halo, self.halo : self.halo + width]
        self.reference = torch.from_numpy(np.ascontiguousarray(np.moveaxis(around, -1, 0))).to(device, torch.int32)
        kinds: dict[str, Callable[[Tensor], Tensor]] = {
            "census": self._census,
            "census_gradient": self._census_gradient,
            "zncc": self._zncc,
            "sad": self._sad,
            "sad_gradient": self._sad_gradient,
        }
        self._cost = kinds[settings.cost]
        self._places = _places(self.windows, width).to(device)
        reach = torch.from_numpy(self.boxes.columns[:, -1:]).to(device)
        columns = torch.arange(self.boxes.margin + 1, self.boxes.margin + 1 + width, device=device)
        lines = (width + 2 * self.boxes.margin + 2) * torch.arange(last - first, device=device)[:, None]
        self._ends = (lines + columns - reach - 1).ravel(), (lines + columns + reach).ravel()
        self._signs = list(self._signs_of(self.reference[0])) if settings.cost in ("census", "census_gradient") else []

    def of(self, warped: Tensor) -> Tensor:
        """Return the mean costs of the band against a warped source.

        Args:
            warped: (P, rows + 2 halo, W, C) int32 grey levels.

        Returns:
            (P, rows, W) float32.
        """
        return self._cost(warped)

    def _census(self, warped: Tensor) -> Tensor:
        return self._box_mean(self._disagreements(warped))

    def _census_gradient(self, warped: Tensor) -> Tensor:
        """Return the census cost, its weight times, plus differences of grey levels and of their gradients, cut off."""
        levels = self._absolute(warped).clamp_(max=MAX_COLOR_COST // 3)
        grey = levels + self._gradients(warped).clamp_(max=MAX_GRADIENT_COST // 3)
        return self._box_mean(self.census_weight * self._disagreements(warped) + GREY_WEIGHT * grey)

    def _disagreements(self, warped: Tensor) -> Tensor:
        """Return how many places of the window differ in their sign; bytes all along, which are quickest."""
        differs: Tensor | None = None
        for sign, other in zip(self._signs, self._signs_of(warped[..., 0]), strict=True):
            other ^= sign
            differs = other if differs is None else differs.add_(other)
        assert differs is not None
        return differs.to(torch.int32)

    def _signs_of(self, pictures: Tensor) -> Iterator[Tensor]:
        """Yield for each place of the window where the pixel there is brighter than the centre, (…, rows, W) 0 or 1."""
        bytes_ = pictures.to(torch.uint8)
        centre = self._inner(bytes_)
        padded = _wrapped(bytes_, self.windows.margin).flatten(-2)
        for place in self._places:
            yield (padded.index_select(-1, place).view(centre.shape) > centre).view(torch.uint8)

    def _sad(self, warped: Tensor) -> Tensor:
        return self._box_mean(self._absolute(warped))

    def _absolute(self, warped: Tensor) -> Tensor:
        """Return the sum of absolute differences of all colours, (P, rows, W), of the rows that the box needs."""
        total = torch.zeros(1, dtype=torch.int32, device=warped.device)
        for color in range(warped.shape[-1]):
            total = total + (self._inner(self.reference[color]) - self._inner(warped[..., color])).abs_()
        return total

    def _sad_gradient(self, warped: Tensor) -> Tensor:
        """Return differences of colours and of their gradients, each cut off."""
        colors = self._absolute(warped).clamp_(max=MAX_COLOR_COST)
        return self._box_mean(colors + self._gradients(warped).clamp_(max=MAX_GRADIENT_COST))

    def _gradients(self, warped: Tensor) -> Tensor:
        """Return the sum of absolute differences of the gradients of all colours, (P, rows, W)."""
        radius, rows_there = self.compare_radius, self.reference.shape[-2]
        middle = (2 * radius + 1) ** 2 // 2
        gradient: Tensor | None = None
        for color in range(warped.shape[-1]):
            difference = self.reference[color] - warped[..., color]
            above, below = (slice(radius + step, rows_there - radius + step) for step in (-1, 1))
            one = (difference[..., below, :] - difference[..., above, :]).abs_()
            padded = _wrapped(difference, self.windows.margin).flatten(-2)
            left, right = (padded.index_select(-1, self._places[middle + step]) for step in (-1, 1))
            one += right.sub_(left).abs_().view(one.shape)
            gradient = one if gradient is None else gradient.add_(one)
        assert gradient is not None
        return gradient

    def _zncc(self, warped: Tensor) -> Tensor:
        """Return 1 − ρ; with n pixels in a window n² times each (co)variance is a whole number."""
        ours, theirs = self.reference[0].to(torch.int64), warped[..., 0].to(torch.int64)
        counts = torch.from_numpy(self._box_counts()).to(warped.device)[:, None]
        sum_r, sum_w = self._box_sum(ours), self._box_sum(theirs)
        variances = [
            ((counts * self._box_sum(picture**2) - total**2).float() / counts**2 + ZNCC_NOISE_VARIANCE)
            for picture, total in ((ours, sum_r), (theirs, sum_w))
        ]
        covariance = (counts * self._box_sum(ours * theirs) - sum_r * sum_w).float() / counts**2
        return 1 - (covariance / (variances[0] * variances[1]).sqrt()).clamp_(-1, 1)

    def _inner(self, pictures: Tensor) -> Tensor:
        """Return the rows that the box needs, (…, rows + 2 box_radius, W), of those that were looked up."""
        return pictures[..., self.compare_radius : pictures.shape[-2] - self.compare_radius, :]

    def _box_counts(self) -> NDArray[np.int64]:
        """Return how many pixels the box around a pixel of each row has, (rows,)."""
        return (2 * self.box_radius + 1) * (2 * self.boxes.columns[:, -1] + 1)

    def _box_mean(self, costs: Tensor) -> Tensor:
        """Return the mean over the box, (P, rows + 2 box_radius, W) to (P, rows, W) float32."""
        shares = torch.from_numpy((1 / self._box_counts()).astype(np.float32)).to(costs.device)
        return self._box_sum(costs).float() * shares[:, None]

    def _box_sum(self, costs: Tensor) -> Tensor:
        """Return the sum over the box, of the same type; by differences of running sums along the columns."""
        rows = costs.shape[-2] - 2 * self.box_radius
        summed = costs[..., :rows, :].clone()
        for step in range(1, 2 * self.box_radius + 1):
            summed += costs[..., step : step + rows, :]
        if self.box_radius == 0:
            return summed
        margin = self.boxes.margin + 1
        running = _wrapped(summed, margin).cumsum(dim=-1, dtype=summed.dtype).flatten(-2)
        left, right = (running.index_select(-1, end) for end in self._ends)
        return right.sub_(left).view(summed.shape)


def _places(windows: WindowBands, width: int) -> Tensor:
    """Return where in padded pictures, each as one row, lies each place of the windows around all pixels, (N, M)."""
    rows = len(windows.columns)
    stride = width + 2 * windows.margin
    corner = stride * np.arange(rows)[:, None] + windows.margin + np.arange(width)
    places = [
        (corner + stride * row + column[:, None]).ravel()
        for row in range(2 * windows.radius + 1)
        for column in windows.columns.T
    ]
    return torch.from_numpy(np.stack(places))


def _wrapped(pictures: Tensor, margin: int) -> Tensor:
    """Return pictures (…, W) with columns of the other side of the seam on either side."""
    if margin == 0:
        return pictures
    return torch.cat([pictures[..., -margin:], pictures, pictures[..., :margin]], dim=-1)


def _mirrored(rows: NDArray[np.int64], height: int) -> NDArray[np.int64]:
    """Return the rows of the picture in which rows beyond a pole come to lie."""
    below = np.where(rows < 0, -1 - rows, rows)
    return np.where(below >= height, 2 * height - 1 - below, below)
