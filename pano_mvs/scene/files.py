"""Files that are written to the output folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal, Self

from pano_mvs.scene.record import Axis, FilePart, Parts, Record, require


@dataclass(frozen=True, eq=False)
class Files(Record):
    """Files for the output folder. The store keeps them, so that a deleted file is written again.

    Attributes:
        files: target, relative to the output folder with forward slashes, to the file that a stage wrote to its
            scratch folder. In a target, `{name}` stands for the image's path relative to the capture, and `{item}`
            for the same without its extension. Stages do not use the names themselves, so that renaming an image
            recomputes nothing.
    """

    axis: ClassVar[Axis | None] = None

    files: Mapping[str, Path]

    def check(self) -> None:
        """Raise ContractError if a target would leave the output folder."""
        for target in self.files:
            path = PurePosixPath(target)
            inside = not path.is_absolute() and ".." not in path.parts and not {"\\", ":", "\0"} & set(target)
            require(inside and bool(path.parts), self, f"target {target!r} is not inside the output folder")

    def to_parts(self) -> Parts:
        """Return the files under numbers, and their targets and all other fields as JSON."""
        meta = super().to_parts()["meta"]
        assert isinstance(meta, dict)
        targets = sorted(meta.pop("files"))
        numbered = {str(number): FilePart(self.files[target]) for number, target in enumerate(targets)}
        return {"meta": {"targets": targets, **meta}, **numbered}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record from the result of `to_parts`; its files are in the store."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        numbered = {name: part.path for name, part in parts.items() if isinstance(part, FilePart)}
        files = {target: numbered[str(number)] for number, target in enumerate(meta["targets"])}
        return super().from_parts({"meta": meta | {"files": files}})


def group_file(name: str, group: int) -> str:
    """Return the name of a group's file: cloud.ply of group 0, cloud_1.ply of group 1.

    >>> group_file("cloud.ply", 0), group_file("cloud.ply", 1)
    ('cloud.ply', 'cloud_1.ply')
    """
    path = PurePosixPath(name)
    return str(path.with_stem(f"{path.stem}_{group}")) if group else name


def item_stems(names: Iterable[str]) -> dict[str, str]:
    """Return the `{item}` of each image: its path without the extension, if that is unique.

    The extension is also kept if a folder of images is named like an image without its extension, followed by a dot:
    the file `{item}.tiff` of the image `000.png` would collide with the folder `000.tiff`.
    """
    found = list(names)
    stems = {name: str(PurePosixPath(name).with_suffix("")) for name in found}
    folders = {parent for name in found for parent in PurePosixPath(name).parents if "." in parent.name}
    taken = {str(folder)[:end].casefold() for folder in folders for end in _dots(str(folder))}
    while True:
        count = Counter(stem.casefold() for stem in stems.values())
        clashing = [
            name
            for name in found
            if (count[stems[name].casefold()] > 1 or stems[name].casefold() in taken) and stems[name] != name
        ]
        if not clashing:
            return stems
        stems.update({name: name for name in clashing})


def _dots(folder: str) -> list[int]:
    """Return the positions of dots in the last component of a path."""
    return [idx for idx in range(folder.rfind("/") + 1, len(folder)) if folder[idx] == "."]


FaceLayout = Literal["cube", "octagon", "icosahedron"]


@dataclass(frozen=True, eq=False)
class FaceFiles(Files):
    """Files of the faces of one panorama for the output folder, with the layout of the faces."""

    axis: ClassVar[Axis | None] = Axis.VIEW

    layout: FaceLayout = "cube"  # name of the layout; see `panorama_faces`
    fov_deg: float = 96.0  # horizontal and vertical field of view of a face
    size_px: int = 0  # width and height of a face
    suffix: str = ".jpg"  # suffix of the image files, such as ".jpg"

    def check(self) -> None:
        """Raise ContractError if a target would leave the output folder, or the faces have no size."""
        Files.check(self)
        require(self.size_px > 0, self, f"size_px must be positive, got {self.size_px}")


Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class LevelPanorama(Files):
    """The files of one level panorama."""

    axis: ClassVar[Axis | None] = Axis.IMAGE

    picture: str = ""  # target of the picture; `{item}` stands for the name of the panorama
    # rotation (three rows) from the world of its group into the axes of the level panorama: x right, y down along
    # gravity, z towards the middle of the picture
    level_from_world: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    # compass heading of the middle of the picture, or None if north is not known
    heading_deg: float | None = None
