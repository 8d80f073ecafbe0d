"""The places over which settings of the dense stages are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pano_mvs.testing.scenes import SCENES
from tests.benchmarks.captures import Capture, read_capture, scene_capture
from tests.repeating.places import REPEATS
from tests.synthetic.places import large_plain_room

SCENE_MAKERS = {**SCENES, **REPEATS, "large_plain_room": large_plain_room}


@dataclass(frozen=True)
class Place:
    """A capture of a place, with which settings are scored.

    Attributes:
        place: name of the place; captures of one place are left out together.
        width: of the panoramas, in pixels.
        views: number of views; each one has all others as sources, up to the limit of the workflow.
        folder: of a capture with truth; None for a synthetic place.
        arguments: of the synthetic place.
    """

    place: str
    width: int
    views: int
    folder: Path | None = None
    arguments: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Name of the capture: the place, the width and the number of views."""
        return f"{self.place}-{self.width}-{self.views}"

    @property
    def key(self) -> str:
        """The name with the arguments, which decide what is rendered."""
        return "-".join([self.name, *(f"{key}={value}" for key, value in self.arguments)])

    def capture(self, scratch: Path) -> Capture:
        """Return the capture; a synthetic one is rendered into a sub-folder of `scratch` once."""
        if self.folder is not None:
            return read_capture(self.folder, width=self.width).first(self.views)
        scene = SCENE_MAKERS[self.place](views=self.views, **dict(self.arguments))
        return scene_capture(scene, scratch / self.key, width=self.width)


SYNTHETIC = (
    Place("courtyard", 384, 4, arguments=(("seed", 11), ("exposure", 0.1))),
    Place("white_room", 384, 3, arguments=(("seed", 12),)),
    Place("poles", 384, 4, arguments=(("seed", 13),)),
    Place("corridor", 384, 5, arguments=(("seed", 14), ("exposure", 0.03))),
    Place("weak_room", 384, 3, arguments=(("seed", 15),)),
    Place("large_plain_room", 384, 4, arguments=(("seed", 16),)),
    Place("colonnade", 384, 3, arguments=(("seed", 17), ("layout", "path"))),
    Place("facade_row", 384, 4, arguments=(("seed", 18), ("layout", "path"), ("exposure", 0.03))),
    Place("stairs", 384, 3, arguments=(("seed", 19), ("layout", "path"))),
    Place("twin_rooms", 384, 3, arguments=(("seed", 20), ("layout", "path"))),
    Place("desk", 384, 4, arguments=(("seed", 0),)),
    Place("desk", 512, 4, arguments=(("seed", 0), ("reach", 1.6), ("top", "weak"))),
)
# Width and number of views of the captures of the first folder, and of each other one.
_FIRST, _OTHERS = ((512, 4), (256, 9)), ((384, 4), (320, 5))


def places_of(folders: Sequence[Path]) -> tuple[Place, ...]:
    """Return the synthetic places, and those of captures with truth."""
    rendered = [
        Place(folder.resolve().name, width, views, folder)
        for idx, folder in enumerate(folders)
        for width, views in (_OTHERS if idx else _FIRST)
    ]
    return (*rendered, *SYNTHETIC)
