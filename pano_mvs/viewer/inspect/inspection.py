"""The analysis of one pixel: its ray, its range after each stage, its neighbours, and its cost curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.cost_curve import CostCurve
from pano_mvs.algorithms.sweep.settings import SweepSettings


@dataclass(frozen=True)
class StageRange:
    """Range of the pixel after one stage.

    Attributes:
        stage: its name in the workflow.
        use: of the stage in the registry.
        range: in scene units; NaN if it has none.
        confidence: 0–255.
    """

    stage: str
    use: str
    range: float
    confidence: int


@dataclass(frozen=True)
class SourceSight:
    """A neighbour's view of the surface point of the pixel.

    Attributes:
        name: of the image.
        baseline: distance between the cameras in scene units.
        parallax_deg: angle at the surface between the two rays.
        pixel_px: (x, y) in the neighbour.
        color_rgb: there.
        masked: whether the neighbour is masked there.
        cost: of the winning range in this neighbour alone, relative to the worst cost; NaN if it does not count.
    """

    name: str
    baseline: float
    parallax_deg: float
    pixel_px: tuple[float, float]
    color_rgb: tuple[int, int, int]
    masked: bool
    cost: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """One pixel of one image.

    Attributes:
        image: its name.
        column: of the pixel, from 0; its centre is at column + ½.
        row: likewise.
        size_hw: of the image at the resolution of the sweep.
        color_rgb: of the pixel.
        ray_in_cam: (3,) unit ray through its centre.
        ray_in_world: (3,) likewise.
        center_in_world: (3,) of the camera, scene units.
        stages: its range after each stage that produces ranges, as far as stored.
        sweep: name of the stage whose cost curve is shown.
        settings: of that sweep.
        curve: its costs.
        sources: its neighbours.
        true_range: in scene units; NaN if unknown.
        notes: further remarks.
    """

    image: str
    column: int
    row: int
    size_hw: tuple[int, int]
    color_rgb: tuple[int, int, int]
    ray_in_cam: NDArray[np.float64]
    ray_in_world: NDArray[np.float64]
    center_in_world: NDArray[np.float64]
    stages: tuple[StageRange, ...]
    sweep: str
    settings: SweepSettings
    curve: CostCurve
    sources: tuple[SourceSight, ...]
    true_range: float
    notes: tuple[str, ...]

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the ray: 0 is ahead, 90 to the right."""
        return float(np.rad2deg(np.arctan2(self.ray_in_cam[0], self.ray_in_cam[2])))

    @property
    def elevation_deg(self) -> float:
        """Elevation of the ray: 90 is up."""
        return float(np.rad2deg(np.arcsin(np.clip(-self.ray_in_cam[1], -1, 1))))
