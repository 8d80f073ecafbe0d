"""The images of a capture: their files, their order, and whether each is a panorama."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from pano_mvs.core.errors import InputError
from pano_mvs.core.files import CACHE_MARK, OUTPUT_MARK
from pano_mvs.core.paths import exists, is_denied, is_file, is_folder, problem_of, resolved
from pano_mvs.core.text import shortened_list
from pano_mvs.io.images.metadata import GPano, find_gpano, orientation_from_exif, position_from_exif, read_container
from pano_mvs.io.images.placement import placed
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.files import item_stems
from pano_mvs.scene.image_file import MAX_PIXELS, check_stated_size, decode_image
from pano_mvs.scene.image_header import has_unread_alpha, holds_floats, is_map, of_file

_JPEG_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".insp"})
_HEIF_SUFFIXES = frozenset({".avif", ".heic", ".heif", ".hif"})
PICTURE_SUFFIXES = _JPEG_SUFFIXES | _HEIF_SUFFIXES | {".png", ".tif", ".tiff", ".webp", ".hdr", ".exr"}
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi"})
UNSTITCHED_SUFFIXES = frozenset({".insv", ".360", ".lrv", ".osv"})
_FISHEYE_SUFFIXES = UNSTITCHED_SUFFIXES - {".360"}  # which shows the faces of a cube
_RAW_SUFFIXES = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".dng", ".gpr", ".iiq", ".nef", ".orf", ".pef", ".raf", ".raw", ".rw2", ".srw"}
)
_OTHER_PICTURES = _RAW_SUFFIXES | {
    *(".bmp", ".dib", ".gif", ".j2k", ".jp2", ".jpf", ".jps", ".jpx", ".jxl", ".jxr", ".mpo", ".pam", ".pbm"),
    *(".pcx", ".pfm", ".pgm", ".pic", ".pnm", ".ppm", ".psb", ".psd", ".ras", ".rgbe", ".tga", ".xcf"),
}
_MAP_SUFFIXES = frozenset({".tif", ".tiff", ".exr"})
_IGNORED_FOLDERS = frozenset({"masks"})
_TURNED = (
    "an EXIF orientation that rotates or mirrors them, which was ignored: the pixels of a panorama are used as "
    "they are stored"
)
_UNREAD_ALPHA = (
    "an alpha channel that is not read, as grey TIFF files: no pixel of them is masked. Save them as PNG, or as "
    "TIFF of colours"
)


@dataclass(frozen=True)
class PictureInfo:
    """The size and the metadata of a panorama."""

    # (height, width) of the full sphere, width = 2 × height, at the resolution of the file. For a crop that was
    # resized, at the resolution of the original, in whose pixels its position is an integer.
    size_hw: tuple[int, int]
    file_size_hw: tuple[int, int]  # (height, width) of the image in the file
    # (left, top, width, height) of the part of the sphere in the file, or None for all of it
    crop_ltwh: tuple[int, int, int, int] | None
    gpano: GPano | None  # its GPano metadata, or None
    warnings: tuple[str, ...] = ()  # warnings about this image, without the file's name
    traits: tuple[str, ...] = ()  # warnings that have the same text for all images to which they apply
    # (latitude deg, longitude deg, altitude m) from its EXIF metadata, or None
    position_lla: tuple[float, float, float] | None = None

    @property
    def full_width_px(self) -> int:
        """Width of the full sphere at the file's own resolution."""
        share = 1.0 if self.crop_ltwh is None else self.file_size_hw[1] / self.crop_ltwh[2]
        return max(1, round(self.size_hw[1] * share))


def list_pictures(folder: Path, notes: list[str] | None = None) -> list[Path]:
    """Return the images in a folder and its subfolders in natural order (2 before 10, ignoring case).

    Hidden files, hidden folders, folders called `masks`, output folders of runs and caches are ignored.

    Raises:
        InputError: if the folder does not exist, cannot be listed, or contains no image.
    """
    if not is_folder(folder):
        raise InputError(
            f"{folder}: no such folder ({problem_of(folder) or 'it is a file'}). Give the folder that "
            "holds the panoramas"
        )
    notes = [] if notes is None else notes
    files = list(files_below(folder, notes))
    pictures = [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
    maps = {path for path in pictures if path.suffix.lower() in _MAP_SUFFIXES and of_file(path, is_map)}
    pictures = [path for path in pictures if path not in maps]
    others = [path for path in files if path.suffix.lower() in _OTHER_PICTURES]
    unstitched = [path for path in files if path.suffix.lower() in UNSTITCHED_SUFFIXES]
    films = [path for path in files if path.suffix.lower() in VIDEO_SUFFIXES]
    kinds = ", ".join(sorted({path.suffix.lower().lstrip(".") for path in others}))
    for skipped, what in (
        (others, f"images of unsupported formats ({kinds}; convert them to JPEG or TIFF to use them)"),
        (maps, "maps of a single quantity, such as ranges (floating-point TIFF or EXR files without colours),"),
        (unstitched, "recordings that are not stitched yet"),
        (films if pictures else [], "videos, which source.video reads,"),
    ):
        if skipped:
            names = [path.name for path in sorted(skipped)]
            notes.append(f"{folder}: {what} are skipped: {shortened_list(names)}")
    if not pictures and unstitched:
        raise InputError(f"{folder}: no images here, but {unstitched_reason(unstitched[0])}")
    if not pictures and films:
        raise InputError(
            f"{folder}: no images here, but the video {films[0].name}. Use source.video: "
            "--set images.use=source.video --set pairs.use=pairs.sequential"
        )
    if not pictures:
        kinds = ", ".join(sorted(suffix.lstrip(".") for suffix in PICTURE_SUFFIXES))
        raise InputError(
            "\n  ".join(
                [f"{folder}: no images here. Supported formats: {kinds}; folders called masks are skipped", *notes]
            )
        )
    return sorted(pictures, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def unstitched_reason(path: Path) -> str:
    """Return why a recording of a two-lens camera cannot be used as it is, and what to do."""
    two_lenses = path.suffix.lower() in _FISHEYE_SUFFIXES
    rig = " Or split it into pictures of its lenses, and use source.dual_fisheye (docs/rigs.md)" if two_lenses else ""
    return (
        f"{path.name}, which a camera with several lenses recorded and nobody has stitched yet. Export it as an "
        f"equirectangular video or as panoramas with the camera maker's program.{rig}"
    )


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sort key that puts 2 before 10 and ignores case; different names have different keys."""
    chunks = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(chunk), "") if chunk.isdecimal() else (1, 0, chunk) for chunk in chunks if chunk], name


def describe_picture(path: Path, data: bytes | None = None, *, max_pixels: int = MAX_PIXELS) -> PictureInfo:
    """Return the size and the metadata of a panorama without decoding it (except HEIC and AVIF).

    An image is a panorama if its GPano metadata describe a whole or cropped one, or, with a warning, if it is exactly
    twice as wide as high.

    Raises:
        InputError: if the file cannot be read, is not an image, is larger than the limit, or is not an equirectangular
            panorama.
    """
    if data is None:
        data = FilePart(path).read_bytes()
    check_stated_size(data, path, max_pixels)
    container = read_container(data)
    gpano, warnings = find_gpano(container.xmp, data)
    if container.warning:
        warnings = (container.warning, *warnings)
    size = container.size_hw or decode_image(path, data, max_pixels=max_pixels).shape[:2]
    height, width = int(size[0]), int(size[1])
    if gpano is not None and gpano.projection_type != "equirectangular":
        raise InputError(
            f"{path}: according to its metadata, it is {gpano.projection_type}, not equirectangular. "
            "Export it as an equirectangular panorama, or remove it"
        )
    placement = placed(path, (height, width), gpano)
    sphere = placement.sphere_hw
    if sphere[0] * sphere[1] > max_pixels:
        raise InputError(
            f"{path}: its GPano metadata say that the full sphere is {sphere[1]}×{sphere[0]} px, more than the "
            f"limit of {max_pixels / 1e6:.0f} megapixels. Correct the metadata, or remove them"
        )
    if gpano is not None and not placement.knows_left:
        gpano = gpano.turned_unknown()
    exif = container.exif
    traits = (*placement.traits, *((_TURNED,) if orientation_from_exif(exif) != 1 else ()))
    if holds_floats(data):
        traits = (*traits, "floating-point colours (HDR), which are tone-mapped to 8 bits, each by its own brightness")
    if has_unread_alpha(data):
        traits = (*traits, _UNREAD_ALPHA)
    if gpano is None:
        traits = (*traits, "no GPano metadata; taken as full spheres, since the width is twice the height")
    warnings = (*warnings, *placement.warnings)
    position_lla = position_from_exif(exif)
    return PictureInfo(sphere, (height, width), placement.crop_ltwh, gpano, warnings, traits, position_lla)


def panorama_in(path: Path) -> Panorama:
    """Return the panorama in an image file at the full size of its sphere; raises as `describe_picture` does."""
    info = describe_picture(path)
    return Panorama(FilePart(path, external=True), info.size_hw, info.size_hw, crop_ltwh=info.crop_ltwh)


def files_below(folder: Path, notes: list[str]) -> Iterator[Path]:
    """Yield the files of a capture, following links, except hidden files, masks, outputs of runs and caches.

    Args:
        notes: a warning is appended for each subfolder that cannot be listed, and each image that is not a file.

    Raises:
        InputError: if the folder itself cannot be listed, or is a cache.
    """
    if exists(folder / CACHE_MARK):
        raise InputError(
            f"{folder}: this is a cache of pano-mvs, in which images of its own lie. Give the folder that "
            "holds the panoramas; if they lie in here, move them to a folder of their own"
        )

    def fail(error: OSError) -> None:
        problem = f"{error.filename}: cannot be listed ({error.strerror})"
        if Path(error.filename) == folder:
            raise InputError(f"{problem}. Correct its permissions or choose another folder")
        notes.append(f"{problem}; its contents are skipped")

    seen: set[Path] = set()
    for root, folders, files in os.walk(folder, followlinks=True, onerror=fail):
        here = Path(root)
        if resolved(here) in seen:
            folders.clear()
            continue
        seen.add(resolved(here))
        folders[:] = sorted(name for name in folders if not _is_left_out(here / name))
        for path in (here / name for name in sorted(files) if not name.startswith(".")):
            if is_file(path) or is_denied(
                path
            ):  # reading a file that cannot be examined raises an error with the reason
                yield path
            elif path.suffix.lower() in PICTURE_SUFFIXES:
                what = "not a regular file" if exists(path) else "a link that leads nowhere"
                notes.append(f"{path}: this is {what}; it is skipped")


def _is_left_out(folder: Path) -> bool:
    name = folder.name
    if name.startswith(".") or name.lower() in _IGNORED_FOLDERS:
        return True
    return exists(folder / OUTPUT_MARK) or exists(folder / CACHE_MARK)


Layout = Literal["auto", "side_by_side", "folders", "suffixes"]


@dataclass(frozen=True, slots=True)
class RigPictures:
    """The pictures of one capture of a rig."""

    # path relative to the folder, without the lens and with the extension .png, before which that of its files is kept
    # if two captures would have the same name
    name: str
    files: tuple[Path, ...]  # the file that contains both pictures side by side, or the file of each lens
    problem: str = ""  # why the capture is incomplete; empty if it is complete


def list_rig_pictures(
    folder: Path, lens_names: Sequence[str], layout: Layout, *, notes: list[str] | None = None
) -> list[RigPictures]:
    """Return the captures in a folder and its subfolders, in natural order.

    Args:
        layout: "side_by_side": each file shows both lenses, the first on the left; "folders": one of the folders in
            the path of a file has the name of its lens, as in front/000.jpg; "suffixes": file names end with a
            separator and the name of the lens, as in 000_front.jpg. "auto": folders if a folder has the name of a lens,
            suffixes if a file does, otherwise side_by_side.
        notes: see `list_pictures`.

    Raises:
        InputError: if the folder contains no images, or none that fit the layout.
    """
    paths = list_pictures(folder, notes)
    names = [PurePosixPath(path.relative_to(folder).as_posix()) for path in paths]
    if layout == "auto":
        layout = _layout(names, lens_names)
    if layout == "side_by_side":
        stems = item_stems(map(str, names))
        return [RigPictures(f"{stems[str(name)]}.png", (path,)) for name, path in zip(names, paths, strict=True)]
    found = list(_pairs(paths, names, lens_names=lens_names, layout=layout))
    if not found:
        example = f"{lens_names[0]}/000.jpg" if layout == "folders" else f"000_{lens_names[0]}.jpg"
        raise InputError(
            f"{folder}: no image belongs to a lens of the calibration ({' or '.join(lens_names)}). Call files like "
            f"{example}, or set layout: side_by_side"
        )
    return found


def _layout(names: Sequence[PurePosixPath], lens_names: Sequence[str]) -> Layout:
    for layout in ("folders", "suffixes"):
        if any(_lens_of(name, lens_names, layout) is not None for name in names):
            return layout
    return "side_by_side"


def _pairs(
    paths: Sequence[Path], names: Sequence[PurePosixPath], *, lens_names: Sequence[str], layout: Layout
) -> Iterator[RigPictures]:
    captures: dict[str, dict[int, list[Path]]] = {}
    for path, name in zip(paths, names, strict=True):
        found = _lens_of(name, lens_names, layout)
        if found is None:
            captures.setdefault(str(name), {})
            continue
        lens_idx, shared = found
        captures.setdefault(shared, {}).setdefault(lens_idx, []).append(path)
    if not any(captures.values()):
        return
    name_of = dict(zip(paths, names, strict=True))
    for shared, files in captures.items():
        if not files:
            yield RigPictures(shared, (), f"does not belong to a lens: no {layout} {' or '.join(lens_names)}")
            continue
        for stem, group in _by_format(shared, files):
            missing = [lens for idx, lens in enumerate(lens_names) if idx not in group]
            problem = f"the picture of the lens {missing[0]} is missing" if missing else ""
            used = tuple(group[idx][0] for idx in sorted(group))
            if len({file.suffix for file in used}) > 1:
                problem = "the pictures of its lenses have different formats; save both in the same"
            yield RigPictures(f"{stem}.png", used, problem)
            for first, *others in group.values():
                for other in others:
                    why = f"shows the same capture and lens as {name_of[first]}; rename or remove one of them"
                    yield RigPictures(str(name_of[other]), (), why)


def _by_format(shared: str, files: Mapping[int, list[Path]]) -> Iterator[tuple[str, dict[int, list[Path]]]]:
    """Yield the names and the files of a capture; if a lens has several files, each format is a capture of its own."""
    suffixes = dict.fromkeys(path.suffix for paths in files.values() for path in paths)
    if len(suffixes) == 1 or all(len(paths) == 1 for paths in files.values()):
        yield shared, dict(files)
        return
    for suffix in suffixes:
        same = {idx: [path for path in paths if path.suffix == suffix] for idx, paths in files.items()}
        yield shared + suffix, {idx: paths for idx, paths in same.items() if paths}


def _lens_of(name: PurePosixPath, lens_names: Sequence[str], layout: Layout) -> tuple[int, str] | None:
    """Return the lens of a file, and its path without the lens and without extension; None if it has no lens."""
    for idx, lens in enumerate(lens_names):
        if layout == "folders":
            folders = name.parts[:-1]
            if lens in folders:
                kept = [part for position, part in enumerate(name.parts) if position != folders.index(lens)]
                return idx, str(PurePosixPath(*kept).with_suffix(""))
        elif (stem := name.stem).endswith(lens) and len(stem) > len(lens) + 1 and stem[-len(lens) - 1] in "_-. ":
            return idx, str(name.with_name(stem[: -len(lens) - 1]))
    return None
