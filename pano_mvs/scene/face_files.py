"""The files of the faces of one panorama, and their layout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from pano_mvs.scene.files import Files
from pano_mvs.scene.record import Axis, Parts, require

FaceLayout = Literal["cube", "octagon", "icosahedron"]


@dataclass(frozen=True, eq=False)
class FaceFiles(Files):
    """Files of the faces of one panorama for the output folder, with the layout of the faces.

    Attributes:
        layout: name of the layout; see `panorama_faces`.
        fov_deg: horizontal and vertical field of view of a face.
        size_px: width and height of a face.
        suffix: suffix of the image files, such as ".jpg".
    """

    axis: ClassVar[Axis | None] = Axis.VIEW

    layout: FaceLayout = "cube"
    fov_deg: float = 96.0
    size_px: int = 0
    suffix: str = ".jpg"

    def check(self) -> None:
        """Raise ContractError if a target would leave the output folder, or the faces have no size."""
        Files.check(self)
        require(self.size_px > 0, self, f"size_px must be positive, got {self.size_px}")

    def to_parts(self) -> Parts:
        """Return the files as `Files` does, with the layout in `meta`."""
        parts = dict(Files.to_parts(self))
        meta = parts["meta"]
        assert isinstance(meta, dict)
        cut = {"layout": self.layout, "fov_deg": self.fov_deg, "size_px": self.size_px, "suffix": self.suffix}
        return parts | {"meta": meta | cut}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record from the result of `to_parts`."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        files = Files.from_parts(parts).files
        return cls(files, meta["layout"], meta["fov_deg"], meta["size_px"], meta["suffix"])
