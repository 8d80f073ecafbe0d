"""Look sources up where the reference's rays would end, many virtual ranges at a time.

A source is packed once: the four bytes that a bilinear sample needs stand in one 32-bit word, over the seam and over
the poles, so that a sample is one gather for each colour instead of four, and none lies at a border.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from pano_mvs.api import SweepInput, pad_panorama
from torch import Tensor


def packed_patches(picture: NDArray[np.uint8], device: torch.device) -> Tensor:
    """Return all 2×2 patches of a panorama, (H, W, C) uint8 to ((H + 1) (W + 1), C) int32.

    Patch (j, i) holds the pixels of rows j − 1, j and columns i − 1, i as
    upper left | lower left << 8 | upper right << 16 | lower right << 24.
    """
    padded = torch.from_numpy(pad_panorama(picture, 1)).to(device, torch.int32)
    upper, lower = padded[:-1], padded[1:]
    patches = upper[:, :-1] | lower[:, :-1] << 8 | upper[:, 1:] << 16 | lower[:, 1:] << 24
    return patches.reshape(-1, picture.shape[2]).contiguous()


class Lookup:
    """One source, for rows of the reference.

    Rows before the first or after the last one of the picture lie beyond a pole: elevations over 90° turn the ray
    around by themselves.
    """

    def __init__(self, work: SweepInput, idx: int, device: torch.device) -> None:
        self.reference_hw = work.reference.shape[0], work.reference.shape[1]
        self.size_hw = work.sources[idx].shape[0], work.sources[idx].shape[1]
        self.device = device
        self.patches = packed_patches(work.sources[idx], device)
        self.valid: Tensor | None = None
        if work.source_valid is not None:
            votes = packed_patches(work.source_valid[idx].astype(np.uint8)[..., None], device)
            self.valid = votes[:, 0] == 0x01010101
        self.rotation = work.source_from_reference[idx].rotation
        self.translation = work.source_from_reference[idx].translation

    def directions(self, first: int, last: int) -> Tensor:
        """Return the rays of some rows in the source's orientation, (3, rows, W) float32."""
        height, width = self.reference_hw
        elevation = np.pi * (0.5 - (np.arange(first, last) + 0.5) / height)[:, None]
        azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
        rays = np.stack(
            [
                np.cos(elevation) * np.sin(azimuth),
                np.broadcast_to(-np.sin(elevation), (last - first, width)),
                np.cos(elevation) * np.cos(azimuth),
            ]
        )
        turned = np.tensordot(self.rotation, rays, axes=1)
        return torch.from_numpy(turned.astype(np.float32)).to(self.device)

    def at(self, directions: Tensor, ranges: NDArray[np.float64]) -> tuple[Tensor, Tensor | None]:
        """Return the source as the reference would see it at some ranges, and where it may vote.

        Args:
            directions: (3, rows, W) of the reference's rays.
            ranges: (P,) virtual ranges.

        Returns:
            (P, rows, W, C) int32 grey levels, and (P, rows, W) bool, or None if it may vote everywhere.
        """
        steps = torch.from_numpy((self.translation / ranges[:, None]).astype(np.float32)).to(self.device)
        x, y, z = (directions[axis] + steps[:, axis, None, None] for axis in range(3))
        height, width = self.size_hw
        columns = torch.atan2(x, z).mul_(width / (2 * math.pi)).add_(width / 2 + 0.5)
        rows = torch.atan2(y, torch.hypot(x, z)).mul_(height / math.pi).add_(height / 2 + 0.5)
        column, row = columns.to(torch.int32).clamp_(max=width), rows.to(torch.int32).clamp_(max=height)
        index = (row * (width + 1) + column).reshape(-1)
        patches = self.patches.index_select(0, index).reshape(*column.shape, -1)
        warped = _blend(patches, (columns - column)[..., None], (rows - row)[..., None])
        if self.valid is None:
            return warped, None
        return warped, self.valid.index_select(0, index).reshape(column.shape)


def _blend(patches: Tensor, right: Tensor, down: Tensor) -> Tensor:
    """Return bilinear samples, rounded, from patches (…, C) and the weights of what lies to the right and below."""
    upper_left, lower_left = (patches & 255).float(), (patches >> 8 & 255).float()
    upper_right, lower_right = (patches >> 16 & 255).float(), (patches >> 24 & 255).float()
    left = upper_left + down * (lower_left - upper_left)
    far = upper_right + down * (lower_right - upper_right)
    return (left + right * (far - left) + 0.5).to(torch.int32)
