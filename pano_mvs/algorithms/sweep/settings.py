"""The settings of a sphere sweep."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from pano_mvs.algorithms.sweep.costs import SWEEP_COSTS, SweepCost
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import check_settings, setting


@dataclass(frozen=True)
class SweepSettings:
    """How a sphere sweep samples, compares and decides.

    Widened by 1/cos of the elevation, windows keep their solid angle. The window of "sad", "sad_gradient" and "zncc" is
    also the box over which they are averaged; the other costs are averaged over `support`. A source's weight in
    "parallax_weighted" is the parallax by which it would notice a change of range; the cheapest sources that hold half
    of all weight count. SGM's penalties, for costs from 0 to 255, grow with the rows of the picture: along the same
    angle, a path then pays the same for the slant of a surface against what it gathers from the pixels. P2 never falls
    below P1: it is max(P1, p2 / (1 + (contrast / p2_contrast)ⁿ)), n = 1 for the falloff "inverse" and 2 for "square".
    The confidence "combined" is the geometric mean of the two others. `derotate` and `exposure` are steps of
    the preparation; census and zncc need no match of exposures. `volume_limit_gb` and `levels` above 1 need the
    backend numba.
    """

    planes: int = setting(128, ge=3, le=4096, doc="number of depth hypotheses")
    spacing: Literal["parallax", "inverse", "log", "uniform"] = setting(
        "parallax",
        doc="spacing of the depth hypotheses: even in 1/range beyond the baseline and in log range within it, or "
        "everywhere in 1/range, log range, or range (the paper)",
    )
    cost: str = setting(
        "census",
        registry=SWEEP_COSTS,
        doc="census, census_gradient (also grey levels and their gradients), zncc (correlation), sad (the "
        "paper's sum of absolute differences), sad_gradient (also gradients of colours), or a plugin's cost",
    )
    window: int = setting(7, ge=1, le=15, odd=True, doc="side of the window of the cost in pixels, odd")
    spherical_window: bool = setting(True, doc="widen windows towards the poles so that they keep their solid angle")
    combination: Literal["sum", "best_half", "best_k", "parallax_weighted"] = setting(
        "best_half",
        doc="sources that count at a pixel: all (the paper), the better half, the `best` ones, or the better "
        "half weighted by parallax; all but the first cope with occlusion",
    )
    best: int = setting(2, ge=1, doc="number of sources of best_k")
    aggregation: Literal["box", "sgm"] = setting("sgm", doc="average over a box (the paper), or semi-global matching")
    support: int = setting(
        3, ge=1, le=15, odd=True, doc="side of the box over which census costs, and costs of plugins, are averaged, odd"
    )
    edge_support: int = setting(
        5,
        ge=1,
        le=9,
        odd=True,
        doc="side of the window over which SGM's costs are averaged again, with little weight for pixels of another "
        "colour; 1: not averaged",
    )
    p1: int = setting(30, ge=0, le=4000, doc="SGM's penalty for a step of one plane, for 512 rows")
    p2: int = setting(800, ge=0, le=4000, doc="SGM's penalty for a larger step, for 512 rows")
    p2_contrast: float = setting(8.0, ge=0, doc="contrast in grey levels at which p2 is halved; 0: p2 is constant")
    p2_falloff: Literal["inverse", "square"] = setting(
        "square", doc="how p2 falls with contrast: by it, or by its square, which spares noise and yields to edges"
    )
    edges: Literal["colors", "grey"] = setting(
        "colors", doc="contrast for p2 and edge_support: the largest of all colours, or grey if the cost uses grey"
    )
    selection: Literal["winner", "parabola", "vfit"] = setting(
        "vfit", doc="the cheapest plane (the paper), or the minimum of a parabola or a V around it"
    )
    confidence: Literal["peak_ratio", "curvature", "combined"] = setting(
        "peak_ratio", doc="margin to the best other minimum, sharpness of the minimum, or both"
    )
    no_match: Literal["invalid", "keep"] = setting(
        "invalid",
        doc="pixels without texture whose winner is the nearest or farthest plane, and all pixels (the sky) "
        "whose winner is a farthest plane without parallax, for which `far` must be unset; the paper keeps them",
    )
    prefilter_diameter: int = setting(
        0, ge=0, le=31, doc="diameter of a bilateral filter of the images before the sweep (the paper: 3); 0: none"
    )
    prefilter_sigma_color: float = setting(25.0, gt=0, doc="standard deviation of the bilateral filter in grey levels")
    prefilter_sigma_space_px: float = setting(25.0, gt=0, doc="standard deviation of the bilateral filter in pixels")
    derotate: bool = setting(False, doc="resample each source to the reference's orientation first (the paper)")
    exposure: bool = setting(True, doc="match the exposure of sources to the reference if the cost compares colours")
    levels: int = setting(
        1,
        ge=1,
        le=4,
        doc="1: test every plane at every pixel; 2 or 3: first sweep at half or a quarter of the resolution to "
        "restrict the search, which is faster",
    )
    volume_limit_gb: float = setting(
        4.0,
        gt=0,
        doc="memory for semi-global matching, in 10⁹ bytes; larger panoramas are matched in overlapping parts",
    )

    def __post_init__(self) -> None:
        """Raise UsageError for values that no sweep can use."""
        check_settings(self)
        least = self.matching_cost.min_window
        if self.window < least:
            raise UsageError(f"{self.cost} needs a window of at least {least}")
        if self.p1 > self.p2:
            raise UsageError(f"0 ≤ p1 ≤ p2 ≤ 4000 must hold, got {self.p1} and {self.p2}")

    def penalties(self, height: int) -> tuple[int, int]:
        """Return P1 and the largest P2 for a picture of `height` rows, such that sums of paths fit 16 bits."""
        scale = height / 512
        # Eight paths of at most 255 + P2 each must fit uint16, and P1 on top of a plane that does not exist.
        return min(round(self.p1 * scale), 5000), min(round(self.p2 * scale), 7900)

    @property
    def matching_cost(self) -> SweepCost:
        """The cost that is named."""
        return SWEEP_COSTS.get(self.cost)

    @property
    def compare_radius(self) -> int:
        """Half side of the window within which one pixel's cost looks around."""
        return self.matching_cost.radii(window=self.window, support=self.support)[0]

    @property
    def box_radius(self) -> int:
        """Half side of the box over which pixel costs are averaged."""
        return self.matching_cost.radii(window=self.window, support=self.support)[1]

    @property
    def worst_cost(self) -> float:
        """The mean cost that SGM takes for the worst there is, 255; half of it is that of a chance match."""
        return float(self.matching_cost.worst(self.window // 2))

    @property
    def cost_scale(self) -> float:
        """The factor that takes a pixel's mean cost to SGM's scale, where 255 is the worst there is."""
        return 255.0 / self.worst_cost

    @property
    def neutral_cost(self) -> float:
        """The mean cost, before scaling, of a plane that no source sees: that of a chance match."""
        return self.worst_cost / 2

    @property
    def weight_share(self) -> float:
        """The share of the sources' weight that counts, the cheapest ones first."""
        return 0.5 if self.combination in ("best_half", "parallax_weighted") else 1.0

    def max_sources(self, count: int) -> int:
        """Return how many of `count` sources count at most."""
        return min(self.best, count) if self.combination == "best_k" else count

    def replace(self, **changes: Any) -> SweepSettings:
        """Return the same settings with some changed."""
        return dataclasses.replace(self, **changes)


SURFACE_SETTINGS = SweepSettings(
    cost="census",
    window=7,
    support=5,
    edge_support=1,
    p1=80,
    p2=1600,
    p2_contrast=15.0,
    p2_falloff="inverse",
    edges="grey",
    no_match="keep",
)
"""Settings of small sweeps that look for surfaces and not for details."""
