"""A panorama that was turned so that gravity points straight down in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from pano_mvs.scene.files import Files
from pano_mvs.scene.record import Axis, Parts

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class LevelPanorama(Files):
    """The files of one level panorama.

    Attributes:
        picture: target of the picture; `{item}` stands for the name of the panorama.
        level_from_world: rotation (three rows) from the world of its group into the axes of the level panorama: x
            right, y down along gravity, z towards the middle of the picture.
        heading_deg: compass heading of the middle of the picture, or None if north is not known.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    picture: str = ""
    level_from_world: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    heading_deg: float | None = None

    def to_parts(self) -> Parts:
        """Return the files under numbers, their targets and the rotation as JSON."""
        parts = dict(super().to_parts())
        meta = parts["meta"]
        assert isinstance(meta, Mapping)
        own = {"picture": self.picture, "level_from_world": self.level_from_world, "heading_deg": self.heading_deg}
        return parts | {"meta": {**meta, **own}}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record from the result of `to_parts`."""
        meta = parts["meta"]
        assert isinstance(meta, Mapping)
        rows = tuple(tuple(map(float, row)) for row in meta["level_from_world"])
        return cls(Files.from_parts(parts).files, meta["picture"], rows, meta["heading_deg"])
