"""The figures of one unit, in a third of the memory of a dict: a run holds those of every unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from struct import Struct

_positions: dict[tuple[str, ...], tuple[dict[str, int], Struct]] = {}


class PackedFigures(Mapping[str, float]):
    """Figures by name; equal to a dict with the same entries."""

    __slots__ = ("_form", "_packed")

    def __init__(self, figures: Mapping[str, float]) -> None:
        """Pack figures; those with the same names share the names."""
        names = tuple(figures)
        if names not in _positions:
            _positions[names] = {name: idx for idx, name in enumerate(names)}, Struct(f"{len(names)}d")
        self._form = _positions[names]
        self._packed = self._form[1].pack(*figures.values())

    def __getitem__(self, name: str) -> float:
        """Return one figure."""
        positions, layout = self._form
        figures: tuple[float, ...] = layout.unpack(self._packed)
        return figures[positions[name]]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._form[0])

    def __len__(self) -> int:
        """Return the number of figures."""
        return len(self._form[0])

    def __repr__(self) -> str:
        """Return the figures as a dict prints them."""
        return repr(dict(self))
