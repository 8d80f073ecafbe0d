"""Write the images of overlapping blocks of a capture as folders of links."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.blocks import divide_capture
from pano_mvs.core.errors import InputError, StoreError, UsageError
from pano_mvs.core.paths import children, exists, is_folder, resolved
from pano_mvs.io.images.captures import list_pictures
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_poses


@dataclass(frozen=True)
class ImageBlock:
    """The images of one block.

    Attributes:
        folder: the folder of links.
        names: of the images, relative to it and to the capture.
    """

    folder: Path
    names: tuple[str, ...]


@dataclass(frozen=True)
class Division:
    """How a capture is divided.

    Attributes:
        size: maximum number of images along the path in a block.
        overlap: number of images that consecutive blocks have in common.
        loop: whether the path ends where it began.
        poses: rough poses in any format that `read_poses` reads, to find where the path returns; None without.
    """

    size: int
    overlap: int
    loop: bool = False
    poses: Path | None = None


def split_images(images: Path, to: Path, division: Division) -> list[ImageBlock]:
    """Divide a folder of images into blocks, and write a folder of links for each (block_1, block_2 …).

    Args:
        images: the folder of the capture, in natural order.
        to: folder to write to; new or empty.
        division: how to divide it.

    Raises:
        UsageError: if a setting or a folder cannot be used.
        InputError: if there are no images, or the poses are of other images.
        StoreError: if a link cannot be made.
    """
    if exists(to) and (not is_folder(to) or children(to)):
        raise UsageError(f"--out {to}: exists and is not an empty folder. Choose a new one")
    if resolved(images) in (resolved(to), *resolved(to).parents):
        raise UsageError(f"--out {to}: is in the folder of the images. Choose a folder elsewhere")
    return link_blocks(images, to, divide_images(images, division))


def divide_images(images: Path, division: Division, *, ignored: Sequence[Path] = ()) -> list[tuple[str, ...]]:
    """Return the names of the images of each block, relative to the folder of the capture.

    Args:
        images: the folder of the capture, in natural order.
        division: how to divide it.
        ignored: files and folders in it that do not belong to the capture, such as masks.

    Raises:
        UsageError: if a setting cannot be used, or all images fit into one block.
        InputError: if there are no images, or the poses are of other images.
    """
    left_out = [path.absolute() for path in ignored]
    names = tuple(
        path.relative_to(images).as_posix()
        for path in list_pictures(images)
        if not any(path.absolute().is_relative_to(place) for place in left_out)
    )
    positions = None if division.poses is None else _positions(division.poses, names)
    blocks = divide_capture(
        names, size=division.size, overlap=division.overlap, loop=division.loop, positions=positions
    )
    if len(blocks) == 1:
        raise UsageError(
            f"{images}: its {len(names)} images fit into one block of {division.size}. Run them without blocks"
        )
    return [tuple(block) for block in blocks]


def link_blocks(images: Path, to: Path, blocks: Sequence[Sequence[str]]) -> list[ImageBlock]:
    """Write a folder of links to the images of each block, and to their masks.

    Raises:
        StoreError: if a link cannot be made.
    """
    found = []
    for number, names in enumerate(blocks, start=1):
        folder = to / f"block_{number}"
        for name in names:
            _link(images / name, folder / name)
        if is_folder(images / "masks"):
            _link(images / "masks", folder / "masks")
        found.append(ImageBlock(folder, tuple(names)))
    return found


def _positions(poses: Path, names: tuple[str, ...]) -> Mapping[str, NDArray[np.float64]]:
    model = read_poses(poses)
    centers = dict(zip(model.names, model.centers, strict=True))
    found = {name: centers[known] for name, known in match_image_names(names, model.names).items()}
    if not found:
        raise InputError(f"{poses}: none of its images is one of this capture")
    return found


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.symlink_to(resolved(source))
    except OSError:  # as on Windows without the right to make symbolic links
        try:
            os.link(source, target)
        except OSError as error:
            raise StoreError(
                f"{target}: cannot be made a link to {source} ({error.strerror}). Choose --out on the same disk"
            ) from error
