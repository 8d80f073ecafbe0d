"""The images whose matches are too few to place them, for which other matches are worth their time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from pano_mvs.scene.record import Axis, Record


@dataclass(frozen=True, eq=False)
class WeakImage(Record):
    """Whether an image needs learned key points.

    Attributes:
        wanted: whether it is weakly matched, or similar to an image that is.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    wanted: bool


@dataclass(frozen=True, eq=False)
class WeakImages(Record):
    """Which images of a capture are weakly matched.

    Attributes:
        weak: names of these images.
        similar: names of other images that they may match.
        others: names of all other images.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    explodes_into: ClassVar[type[Record] | None] = WeakImage

    weak: tuple[str, ...] = field(default=())
    similar: tuple[str, ...] = field(default=())
    others: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        """Convert the names, which are stored as lists."""
        for name in ("weak", "similar", "others"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    def explode(self) -> Mapping[str, WeakImage]:
        """Return for each image whether it needs learned key points."""
        wanted = {*self.weak, *self.similar}
        return {name: WeakImage(name in wanted) for name in (*self.weak, *self.similar, *self.others)}
