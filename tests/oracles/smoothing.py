"""Slow, obvious version of the heights of surfaces above the points of a cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def surface_heights(
    points: NDArray[np.float32], normals: NDArray[np.float32], sigmas: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return what `smooth.surface_heights` returns, if all points of a cell count."""
    heights = np.zeros(len(points))
    for i, (point, normal, sigma) in enumerate(zip(points.astype(float), normals.astype(float), sigmas, strict=True)):
        across = np.linalg.svd(normal[None])[2][1:]
        offsets = points.astype(float) - point
        height = offsets @ normal
        place = offsets @ across.T / (2 * float(sigma))
        share = (place**2).sum(axis=1)
        deviation = height**2 / (6.25 * (sigma**2 + sigmas.astype(float) ** 2))
        near = (share < 1) & (deviation < 1) & (normals.astype(float) @ normal >= 0.8)
        weight = np.where(near, (1 - share) ** 2 * (1 - deviation) ** 2 / sigmas.astype(float) ** 2, 0.0)
        center = weight @ place / weight.sum()
        if near.sum() < 6 or np.linalg.norm(center) >= 0.3:
            continue
        root = np.sqrt(weight)[:, None]
        design = np.column_stack([np.ones(len(points)), place])
        heights[i] = np.linalg.lstsq(root * design, root[:, 0] * height, rcond=None)[0][0]
    return heights
