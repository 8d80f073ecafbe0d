"""Files to deliver into the output folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar, Self

from pano_mvs.scene.record import Axis, FilePart, Parts, Record, require


@dataclass(frozen=True, eq=False)
class Files(Record):
    """Files to deliver into the output folder; the store keeps them, so that a deleted one is written again.

    Attributes:
        files: target, relative to the output folder with forward slashes, to the file that a stage wrote into its
            scratch folder. `{item}` in a target stands for the image's path relative to the capture without its
            extension, `{name}` for the path with it; the stage need not know them, so renaming an image recomputes
            nothing.
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
        """Return the files under numbers, and their targets as JSON."""
        targets = sorted(self.files)
        parts: dict[str, FilePart | dict[str, list[str]]] = {"meta": {"targets": targets}}
        for number, target in enumerate(targets):
            parts[str(number)] = FilePart(self.files[target])
        return parts

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the files that `to_parts` gave, at their places in the store."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        files: dict[str, Path] = {}
        for number, target in enumerate(meta["targets"]):
            part = parts[str(number)]
            assert isinstance(part, FilePart)
            files[target] = part.path
        return cls(files)


def group_file(name: str, group: int) -> str:
    """Return the name of a group's file: cloud.ply of group 0, cloud_1.ply of group 1.

    >>> group_file("cloud.ply", 0), group_file("cloud.ply", 1)
    ('cloud.ply', 'cloud_1.ply')
    """
    path = PurePosixPath(name)
    return str(path.with_stem(f"{path.stem}_{group}")) if group else name


def item_stems(names: Iterable[str]) -> dict[str, str]:
    """Return the `{item}` of each image: its path without the extension, kept where two would collide.

    It is kept too where a folder of images is called like an image without its extension, and then a dot: a file
    `{item}.tiff` of the image `000.png` would stand where the folder `000.tiff` of others belongs.
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
    """Return where the dots are in the last part of a path."""
    return [idx for idx in range(folder.rfind("/") + 1, len(folder)) if folder[idx] == "."]
