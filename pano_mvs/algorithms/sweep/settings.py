"""What a sphere sweep can be told."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from pano_mvs.algorithms.sweep.costs.registry import plugin_cost
from pano_mvs.core.errors import UsageError

# Costs are cut off: what differs by more is simply wrong. Grey levels, summed over R, G and B …
_LARGEST_SAD, LARGEST_COLOR_COST = 96, 30
# … and differences over two pixels, summed over both directions as well.
LARGEST_GRADIENT_COST = 60
# A level of grey differences counts this much beside census, and both are the same at their worst.
GREY_WEIGHT = 8
_CENSUS_SHARE = 4
_LARGEST_GREY = GREY_WEIGHT * (LARGEST_COLOR_COST + LARGEST_GRADIENT_COST) // 3
# The variance of noise, in grey levels squared, against which correlation has to stand out.
ZNCC_NOISE_VARIANCE = 4.0

_PENALTY_ROWS = 512
# Eight paths of at most 255 + P2 each must fit uint16, and P1 on top of a plane that does not exist.
_LARGEST_P1, _LARGEST_P2 = 5000, 7900


@dataclass(frozen=True)
class SweepSettings:
    """How a sphere sweep samples, compares and decides.

    Attributes:
        planes: number of virtual ranges, at least 3.
        spacing: virtual ranges uniform in 1/range, in log range or in range (the paper's).
        cost: "census" (Hamming distance of the signs of differences to the window's centre; blind to exposure), "zncc"
            (1 − zero-mean normalised cross-correlation; blind to it too), "sad" (sum of absolute differences of R, G
            and B; the paper's), "sad_gradient" (differences of colours and of their gradients, both cut off),
            "census_gradient" (census and, with a quarter of its weight, differences of grey levels and of their
            gradients, cut off) or a plugin's.
        window: side in pixels, odd, of the window of either cost (the paper: 7).
        spherical_window: widen the windows' columns by 1/cos of the elevation, so that they keep their solid angle.
        combination: "sum" over the sources (the paper's), or the mean of the "best_half" of them at each pixel and
            plane, which leaves out the sources in which the point is hidden; or of the "best_k"; or
            "parallax_weighted", the cheapest sources that hold half of all weight, a source's weight being the
            parallax by which it would notice a change of range.
        best: how many sources "best_k" takes.
        aggregation: "box": winner takes all after a box sum; "sgm": semi-global matching over eight paths.
        support: side in pixels, odd, of the box over which census costs, and plugins', are averaged before the
            decision; 1 is none. The box of all other costs is the window itself.
        p1: SGM's penalty of a step by one plane between neighbours, for a picture of 512 rows; costs go from 0 to 255.
        p2: SGM's penalty of a larger step, likewise. Both grow with the rows: along the same angle, a path then pays
            the same for the slant of a surface against what it gathers from the pixels.
        p2_contrast: grey levels of contrast between neighbours at which p2 is halved (never below p1); 0 keeps it.
        selection: the cheapest plane, "winner" (the paper's), or where between the planes a "parabola" or a symmetric
            V ("vfit") through its cost and its neighbours' has its minimum.
        confidence: "peak_ratio" (how much dearer the best rival is), "curvature" (how sharp the minimum is) or
            "combined", their geometric mean.
        no_match: what becomes of bare pixels that run to the nearest or the farthest plane, and of all that run to a
            farthest plane which cannot be told from infinity (the sky): "invalid", or "keep" the plane (the paper).
        prefilter_diameter: diameter of a bilateral filter of all pictures before the sweep; 0 is none (the paper: 3).
        prefilter_sigma_color: its width in grey levels (the paper: 25).
        prefilter_sigma_space_px: its width in pixels (the paper: 25).
        derotate: turn each source to the reference's orientation by resampling first (the paper), instead of looking
            it up as it is.
        exposure: match each source to the reference by a gain and an offset for each colour before comparing by
            differences; census and zncc need none.
        levels: 1: every plane everywhere; 2: a sweep at half the resolution guides that at the full one, 3: one at a
            quarter guides that; see `coarse_to_fine`. More is faster. Needs the backend numba.
        volume_limit_gb: the memory in 10⁹ bytes that semi-global matching may take for its volume. A larger one is
            matched in parts that overlap, which changes next to nothing. Needs the backend numba.
    """

    planes: int = 128
    spacing: Literal["inverse", "log", "uniform"] = "inverse"
    cost: str = "census"
    window: int = 7
    spherical_window: bool = True
    combination: Literal["sum", "best_half", "best_k", "parallax_weighted"] = "best_half"
    best: int = 2
    aggregation: Literal["box", "sgm"] = "sgm"
    support: int = 5
    p1: int = 80
    p2: int = 1600
    p2_contrast: float = 15.0
    selection: Literal["winner", "parabola", "vfit"] = "vfit"
    confidence: Literal["peak_ratio", "curvature", "combined"] = "peak_ratio"
    no_match: Literal["invalid", "keep"] = "invalid"
    prefilter_diameter: int = 0
    prefilter_sigma_color: float = 25.0
    prefilter_sigma_space_px: float = 25.0
    derotate: bool = False
    exposure: bool = True
    levels: int = 1
    volume_limit_gb: float = 4.0

    def __post_init__(self) -> None:
        """Raise UsageError for values that no sweep can use."""
        plugin_cost(self.cost)
        _require(3 <= self.planes <= 4096, f"planes must be 3 to 4096, got {self.planes}")
        for name in ("window", "support"):
            side = getattr(self, name)
            _require(side % 2 == 1 and 1 <= side <= 15, f"{name} must be odd and 1 to 15, got {side}")
        least = 3 if self.cost in ("census", "census_gradient", "zncc") else 1
        _require(self.window >= least, f"{self.cost} needs a window of at least {least}")
        _require(1 <= self.levels <= 4, f"levels must be 1 to 4, got {self.levels}")
        _require(self.volume_limit_gb > 0, f"volume_limit_gb must be positive, got {self.volume_limit_gb}")
        _require(self.best >= 1, f"best must be at least 1, got {self.best}")
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
        return {"zncc": 0, "sad": 0, "sad_gradient": 1}.get(self.cost, self.window // 2)

    @property
    def box_radius(self) -> int:
        """Half side of the box over which pixel costs are averaged."""
        return self.window // 2 if self.cost in ("zncc", "sad", "sad_gradient") else self.support // 2

    @property
    def worst_cost(self) -> float:
        """The mean cost that SGM takes for the worst there is, 255; half of it is that of a chance match.

        A census cost is at most window² − 1, a plugin's 1.
        """
        largest = {
            "census": self.window**2 - 1,
            "census_gradient": self.census_weight * (self.window**2 - 1) + _LARGEST_GREY,
            "sad": _LARGEST_SAD,
            "sad_gradient": LARGEST_COLOR_COST + LARGEST_GRADIENT_COST,
            "zncc": 2,
        }
        return float(largest.get(self.cost, 1))

    @property
    def census_weight(self) -> int:
        """What a disagreement counts beside grey levels in "census_gradient": at worst, all of them four times as much.

        With equal weights a mirror's picture is matched behind it; without grey levels plain walls are not matched.
        """
        return _CENSUS_SHARE * max(1, round(_LARGEST_GREY / max(1, self.window**2 - 1)))

    @property
    def cost_scale(self) -> float:
        """The factor that takes a pixel's mean cost to SGM's scale, where 255 is the worst there is."""
        return 255.0 / self.worst_cost

    @property
    def neutral_cost(self) -> float:
        """The mean cost, before scaling, of a plane that no source sees: that of a chance match."""
        return self.worst_cost / 2

    @property
    def compares_colors(self) -> bool:
        """Whether R, G and B are compared, and exposure matters, rather than grey values alone."""
        own = plugin_cost(self.cost)
        return own.colors if own is not None else self.cost in ("sad", "sad_gradient")

    @property
    def minds_exposure(self) -> bool:
        """Whether levels are compared as they are, so that exposures have to be matched first."""
        return self.compares_colors or self.cost == "census_gradient"

    @property
    def weight_share(self) -> float:
        """The share of the sources' weight that counts, the cheapest ones first."""
        return 0.5 if self.combination in ("best_half", "parallax_weighted") else 1.0

    def most_sources(self, count: int) -> int:
        """Return how many of `count` sources count at most."""
        return min(self.best, count) if self.combination == "best_k" else count

    def replace(self, **changes: object) -> SweepSettings:
        """Return the same settings but for those named."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise UsageError(what)
