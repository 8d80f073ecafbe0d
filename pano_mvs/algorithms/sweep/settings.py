"""What a sphere sweep can be told."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from pano_mvs.core.errors import UsageError

_PENALTY_ROWS = 512
# Eight paths of at most 255 + P2 each must fit uint16, and P1 on top of a plane that does not exist.
_LARGEST_P1, _LARGEST_P2 = 5000, 7900


@dataclass(frozen=True)
class SweepSettings:
    """How a sphere sweep samples, compares and decides.

    Attributes:
        planes: number of virtual ranges, at least 3.
        spacing: virtual ranges uniform in 1/range, in log range or in range (the paper's).
        cost: "census" (Hamming distance of the signs of differences to the window's centre; blind to exposure) or
            "sad" (sum of absolute differences of R, G and B; the paper's).
        window: side in pixels, odd, of the window of either cost (the paper: 7).
        spherical_window: widen the windows' columns by 1/cos of the elevation, so that they keep their solid angle.
        combination: "sum" over the sources (the paper's), or the mean of the "best_half" of them at each pixel and
            plane, which leaves out the sources in which the point is hidden.
        aggregation: "box": winner takes all after a box sum; "sgm": semi-global matching over eight paths.
        support: side in pixels, odd, of the box over which census costs are averaged before the decision; 1 is none.
            The box of SAD costs is the window itself.
        p1: SGM's penalty of a step by one plane between neighbours, for a picture of 512 rows; costs go from 0 to 255.
        p2: SGM's penalty of a larger step, likewise. Both grow with the rows: along the same angle, a path then pays
            the same for the slant of a surface against what it gathers from the pixels.
        p2_contrast: grey levels of contrast between neighbours at which p2 is halved (never below p1); 0 keeps it.
        subplane: refine the winner between the planes by a parabola.
        prefilter_diameter: diameter of a bilateral filter of all pictures before the sweep; 0 is none (the paper: 3).
        prefilter_sigma_color: its width in grey levels (the paper: 25).
        prefilter_sigma_space_px: its width in pixels (the paper: 25).
        exposure: match each source to the reference by a gain and an offset for each colour before comparing by SAD.
    """

    planes: int = 128
    spacing: Literal["inverse", "log", "uniform"] = "inverse"
    cost: Literal["census", "sad"] = "census"
    window: int = 7
    spherical_window: bool = True
    combination: Literal["sum", "best_half"] = "best_half"
    aggregation: Literal["box", "sgm"] = "sgm"
    support: int = 5
    p1: int = 80
    p2: int = 1600
    p2_contrast: float = 15.0
    subplane: bool = True
    prefilter_diameter: int = 0
    prefilter_sigma_color: float = 25.0
    prefilter_sigma_space_px: float = 25.0
    exposure: bool = True

    def __post_init__(self) -> None:
        """Raise UsageError for values that no sweep can use."""
        _require(3 <= self.planes <= 4096, f"planes must be 3 to 4096, got {self.planes}")
        for name in ("window", "support"):
            side = getattr(self, name)
            _require(side % 2 == 1 and 1 <= side <= 15, f"{name} must be odd and 1 to 15, got {side}")
        _require(self.cost == "sad" or self.window >= 3, "census needs a window of at least 3")
        _require(0 <= self.p1 <= self.p2 <= 4000, f"0 ≤ p1 ≤ p2 ≤ 4000 must hold, got {self.p1} and {self.p2}")
        _require(self.p2_contrast >= 0, f"p2_contrast cannot be negative, got {self.p2_contrast}")
        _require(0 <= self.prefilter_diameter <= 31, f"prefilter_diameter must be 0 to 31, got "
                                                     f"{self.prefilter_diameter}")  # fmt: skip

    def penalties(self, height: int) -> tuple[int, int]:
        """Return P1 and the largest P2 for a picture of `height` rows, such that sums of paths fit 16 bits."""
        scale = height / _PENALTY_ROWS
        return min(round(self.p1 * scale), _LARGEST_P1), min(round(self.p2 * scale), _LARGEST_P2)

    @property
    def compare_radius(self) -> int:
        """Half side of the window within which one pixel's cost looks around."""
        return self.window // 2 if self.cost == "census" else 0

    @property
    def box_radius(self) -> int:
        """Half side of the box over which pixel costs are averaged."""
        return self.support // 2 if self.cost == "census" else self.window // 2

    @property
    def cost_scale(self) -> float:
        """The factor that takes a pixel's mean cost to SGM's scale, where 255 is the worst there is.

        A census cost is at most window² − 1. Absolute differences are cut off at 32 levels a colour: what differs by
        more is simply wrong.
        """
        return 255.0 / (self.window**2 - 1) if self.cost == "census" else 255.0 / 96.0

    @property
    def neutral_cost(self) -> float:
        """The mean cost, before scaling, of a plane that no source sees: that of a chance match."""
        return (self.window**2 - 1) / 2 if self.cost == "census" else 48.0

    def replace(self, **changes: object) -> SweepSettings:
        """Return the same settings but for those named."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise UsageError(what)
