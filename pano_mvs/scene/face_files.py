"""The files of one panorama's faces, and how it was cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from pano_mvs.scene.files import Files
from pano_mvs.scene.record import Axis, Parts, require

FaceLayout = Literal["cube", "octagon", "icosahedron"]


@dataclass(frozen=True, eq=False)
class FaceFiles(Files):
    """Files of the faces of one panorama, to be delivered, with what whoever describes the faces must know.

    Attributes:
        layout: name of the layout, as of `panorama_faces`.
        fov_deg: field of view of a face, both ways.
        size_px: width and height of a face.
        suffix: of the pictures' files, such as ".jpg".
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
        """Return the files as `Files` does, with the cut beside the targets."""
        parts = dict(Files.to_parts(self))
        meta = parts["meta"]
        assert isinstance(meta, dict)
        cut = {"layout": self.layout, "fov_deg": self.fov_deg, "size_px": self.size_px, "suffix": self.suffix}
        return parts | {"meta": meta | cut}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return what `to_parts` gave."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        files = Files.from_parts(parts).files
        return cls(files, meta["layout"], meta["fov_deg"], meta["size_px"], meta["suffix"])
