"""Pairs of images to match, and source images of each reference view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from pano_mvs.core.file_names import PAIR_SEPARATOR
from pano_mvs.scene.record import Axis, Record, require


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
