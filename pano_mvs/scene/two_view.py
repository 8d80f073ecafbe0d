"""Pairs of images, views with their neighbours, and two-view geometry: verified matches and a relative pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.file_names import PAIR_SEPARATOR
from pano_mvs.scene.record import Axis, Part, Parts, Record, require, require_array


@dataclass(frozen=True, eq=False)
class TwoView(Record):
    """The two-view geometry of a pair; falsy, with a reason, if none was found.

    Attributes:
        matches_idx: (M, 2) int32 verified matches: index of the key point in the first and in the second image.
        rotation: (3, 3) float64 of second_from_first.
        direction: (3,) float64 unit translation of second_from_first; its length is unknown.
        residuals_rad: (M,) float32 angular Sampson error of each verified match.
        geometry: "general"; "rotation" (both images from the same position: no direction, no range); or "none".
        reason: why the geometry is not general.
        candidates: number of matches before verification.
        log10_false_alarms: log₁₀ of the expected number of equally good geometries among random matches.
        parallax_deg: median angle between the two rays of a verified match after de-rotation.
        rotation_std_deg: standard deviation of the rotation about its least certain axis, from the matches.
        direction_std_deg: the same for the direction; both are 0 unless the geometry is general.
        unverified_idx: (U, 2) int32 the other matches, which do not agree with the geometry; None if unknown.
        alternative_rotations: (K, 3, 3) float64 of second_from_first of the runner-up geometries, best supported first,
            or most probable first if a network has found the matches; None, as the next four, without runners-up.
            Repeated structure often makes a false geometry the best. Those of a pair whose geometry is "none" are
            hypotheses: each by itself may be chance.
        alternative_directions: (K, 3) float64 their unit translations.
        alternative_sizes: (K,) int32 number of matches that support each.
        alternative_matches_idx: (S, 2) int32 these matches, ordered by geometry, S = Σ sizes. A match may
            support several geometries.
        alternative_residuals_rad: (S,) float32 their angular Sampson errors.
    """

    axis: ClassVar[Axis | None] = Axis.PAIR
    kind_version: ClassVar[int] = 4

    matches_idx: NDArray[np.int32]
    rotation: NDArray[np.float64]
    direction: NDArray[np.float64]
    residuals_rad: NDArray[np.float32]
    geometry: Literal["general", "rotation", "none"]
    reason: str = ""
    candidates: int = 0
    parallax_deg: float = 0.0
    rotation_std_deg: float = 0.0
    direction_std_deg: float = 0.0
    log10_false_alarms: float = 0.0
    unverified_idx: NDArray[np.int32] | None = None
    alternative_rotations: NDArray[np.float64] | None = None
    alternative_directions: NDArray[np.float64] | None = None
    alternative_sizes: NDArray[np.int32] | None = None
    alternative_matches_idx: NDArray[np.int32] | None = None
    alternative_residuals_rad: NDArray[np.float32] | None = None

    @staticmethod
    def failed(reason: str, *, candidates: int = 0, unverified_idx: NDArray[np.int32] | None = None) -> TwoView:
        """Return the falsy value for a pair without geometry."""
        none = TwoView(np.zeros((0, 2), np.int32), np.eye(3), np.zeros(3), np.zeros(0, np.float32), "none", reason)
        return replace(none, candidates=candidates, unverified_idx=unverified_idx)

    def __bool__(self) -> bool:
        """Return whether the pair has a general geometry: a rotation and a direction of translation."""
        return self.geometry == "general"

    def __len__(self) -> int:
        """Return the number of verified matches."""
        return len(self.matches_idx)

    @property
    def all_matches_idx(self) -> NDArray[np.int32]:
        """All known matches before verification, (M + U, 2)."""
        if self.unverified_idx is None:
            return self.matches_idx
        return np.concatenate([self.matches_idx, self.unverified_idx])

    @cached_property
    def residual_deg(self) -> float:
        """Median residual of the verified matches; 0 if there are none."""
        return float(np.rad2deg(np.median(self.residuals_rad))) if len(self) else 0.0

    @property
    def alternatives(self) -> tuple[TwoView, ...]:
        """The runner-up geometries in their order, each as a two-view geometry of its own."""
        if (
            self.alternative_sizes is None
            or self.alternative_rotations is None
            or self.alternative_directions is None
            or self.alternative_matches_idx is None
            or self.alternative_residuals_rad is None
        ):
            return ()
        ends = np.cumsum(self.alternative_sizes)
        return tuple(
            TwoView(
                matches_idx=self.alternative_matches_idx[end - size : end],
                rotation=rotation,
                direction=direction,
                residuals_rad=self.alternative_residuals_rad[end - size : end],
                geometry="general",
                candidates=self.candidates,
            )
            for rotation, direction, size, end in zip(
                self.alternative_rotations, self.alternative_directions, self.alternative_sizes, ends, strict=True
            )
        )

    def with_alternatives(self, alternatives: Sequence[TwoView]) -> TwoView:
        """Return the same geometry with these runner-ups in place of its own."""
        if not alternatives:
            return replace(
                self,
                alternative_rotations=None,
                alternative_directions=None,
                alternative_sizes=None,
                alternative_matches_idx=None,
                alternative_residuals_rad=None,
            )
        return replace(
            self,
            alternative_rotations=np.stack([view.rotation for view in alternatives]),
            alternative_directions=np.stack([view.direction for view in alternatives]),
            alternative_sizes=np.array([len(view) for view in alternatives], np.int32),
            alternative_matches_idx=np.concatenate([view.matches_idx for view in alternatives]),
            alternative_residuals_rad=np.concatenate([view.residuals_rad for view in alternatives]),
        )

    def check(self) -> None:
        """Raise ContractError unless the arrays agree."""
        require_array(self, "matches_idx", dtype=np.int32, shape=(None, 2))
        require_array(self, "rotation", dtype=np.float64, shape=(3, 3))
        require_array(self, "direction", dtype=np.float64, shape=(3,))
        require_array(self, "residuals_rad", dtype=np.float32, shape=(len(self.matches_idx),))
        if self.unverified_idx is not None:
            require_array(self, "unverified_idx", dtype=np.int32, shape=(None, 2))
        if self.alternative_sizes is not None:
            sizes = require_array(self, "alternative_sizes", dtype=np.int32, shape=(None,))
            require_array(self, "alternative_rotations", dtype=np.float64, shape=(len(sizes), 3, 3))
            require_array(self, "alternative_directions", dtype=np.float64, shape=(len(sizes), 3))
            require_array(self, "alternative_matches_idx", dtype=np.int32, shape=(int(sizes.sum()), 2))
            require_array(self, "alternative_residuals_rad", dtype=np.float32, shape=(int(sizes.sum()),))


@dataclass(frozen=True, eq=False)
class TwoViews(Record):
    """The two-view geometries of all pairs of a capture, for stages that judge pairs together."""

    axis: ClassVar[Axis | None] = Axis.ONE
    explodes_into: ClassVar[type[Record] | None] = TwoView

    views: Mapping[tuple[str, str], TwoView] = field(default_factory=dict)

    def explode(self) -> Mapping[str, TwoView]:
        """Return the geometry of each pair by the name of its unit."""
        return {pair_name(*pair): view for pair, view in self.views.items()}

    def check(self) -> None:
        """Raise ContractError unless every geometry is valid."""
        for view in self.views.values():
            view.check()

    def to_parts(self) -> Parts:
        """Return the arrays of all pairs, each with the number of its pair in its name, and the rest as JSON."""
        parts: dict[str, Part] = {}
        rest: list[dict[str, object]] = []
        for number, view in enumerate(self.views.values()):
            own = dict(view.to_parts())
            meta = own.pop("meta")
            assert isinstance(meta, dict)
            rest.append(meta)
            parts.update({f"{name}_{number}": part for name, part in own.items()})
        parts["meta"] = {"pairs": [pair_name(*pair) for pair in self.views], "rest": rest}
        return parts

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record from the result of `to_parts`."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        own: list[dict[str, Part]] = [{"meta": rest} for rest in meta["rest"]]
        for name, part in parts.items():
            if name != "meta":
                array, _, number = name.rpartition("_")
                own[int(number)][array] = part
        views = [TwoView.from_parts(one) for one in own]
        return cls(dict(zip(map(pair_from_name, meta["pairs"]), views, strict=True)))


@dataclass(frozen=True, eq=False)
class Pairs(Record):
    """The pairs of images to match: the index of the pair axis.

    Attributes:
        pairs: (first, second) image names, first before second in the capture's order; no pair twice.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    pairs: tuple[tuple[str, str], ...]

    def check(self) -> None:
        """Raise ContractError if a pair is listed twice or an image is paired with itself."""
        require(len({frozenset(pair) for pair in self.pairs}) == len(self.pairs), self, "a pair is listed twice")
        require(all(first != second for first, second in self.pairs), self, "an image is paired with itself")

    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Return the pair axis: unit name to its two images."""
        return {pair_name(first, second): (first, second) for first, second in self.pairs}


@dataclass(frozen=True, eq=False)
class Views(Record):
    """The reference images to sweep, each with its source images, best first: the index of the view axis.

    Attributes:
        neighbours: reference image name to the names of its source images.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    neighbours: dict[str, tuple[str, ...]]

    def check(self) -> None:
        """Raise ContractError if an image is its own neighbour."""
        for reference, sources in self.neighbours.items():
            require(reference not in sources, self, f"{reference} is its own neighbour")

    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Return the view axis: reference to its neighbours in order."""
        return {reference: tuple(sources) for reference, sources in self.neighbours.items()}


def pair_name(first: str, second: str) -> str:
    """Return the name of the unit of two images."""
    return f"{first}{PAIR_SEPARATOR}{second}"


def pair_from_name(name: str) -> tuple[str, str]:
    """Return the two images of a unit of the pair axis."""
    first, _, second = name.partition(PAIR_SEPARATOR)
    return first, second
