"""Copies among the panoramas of a capture: the same picture again, turned about the vertical, resized, or saved again.

A copy shows the world from the same place, so that it adds nothing, but it counts as further evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.kept_file import KeptFile
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import MAX_PIXELS, decode_image, decode_picture
from pano_mvs.scene.image_header import holds_floats, stated_size

_SIZE_HW = (128, 256)
# Of 512 magnitudes: such copies agree by .98 and more, other panoramas by .89 and less (rooms, a city, a flat).
_SAMPLES, _MIN_AGREEMENT = 512, 0.9
_ROWS_AT_ONCE = 1024
_REDUCED = {8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2}


@dataclass(frozen=True)
class Copy:
    """What a picture is a copy of."""

    original: str  # name of the earlier picture
    turn_deg: float  # how far the copy is turned to the left about the vertical, from 0 to 360


def find_copies(paths: Mapping[str, Path], *, max_pixels: int = MAX_PIXELS, read: bool = True) -> dict[str, Copy]:
    """Return, for each picture that is a copy of an earlier one, which one.

    Two pictures are compared by the largest circular correlation of their fine structure over all turns, if some of the
    magnitudes of its spectrum agree: turns do not change these.

    Args:
        paths: of the pictures, by name. Those that OpenCV does not read are compared with none.
        read: whether to read the pictures that no earlier command has read, which takes long; else they are not copies.
    """
    found = {name: _magnitudes(path, max_pixels, read=read) for name, path in paths.items()}
    known = {name: magnitudes for name, magnitudes in found.items() if magnitudes.any()}
    if len(known) < 2:
        return {}
    names, magnitudes = list(known), np.array(list(known.values()))
    copies: dict[str, Copy] = {}

    @lru_cache(maxsize=1024)  # of 132 kB each
    def spectrum(name: str) -> NDArray[np.complex64] | None:
        picture = _reduced(paths[name], max_pixels)
        return None if picture is None else _spectrum(picture)

    for first in range(0, len(names), _ROWS_AT_ONCE):
        likely = magnitudes[first : first + _ROWS_AT_ONCE] @ magnitudes.T >= _MIN_AGREEMENT
        for later, row in enumerate(likely, start=first):
            for earlier in np.flatnonzero(row[:later]).tolist():
                own, other = (None if names[earlier] in copies else spectrum(names[at]) for at in (later, earlier))
                if own is None or other is None:
                    continue
                correlation = np.fft.irfft((np.conj(own) * other).sum(axis=0), _SIZE_HW[1])
                best = int(correlation.argmax())
                # Copies at a quarter of the size, or saved as JPEG of quality 30, have .91 and more; other panoramas
                # .77 and less (20 places with up to 44 panoramas, some with a tripod or the same logo in each).
                if correlation[best] >= 0.85:
                    copies[names[later]] = Copy(names[earlier], 360 * best / _SIZE_HW[1])
                    break
    return copies


def _magnitudes(path: Path, max_pixels: int, *, read: bool) -> NDArray[np.float32]:
    """Return what is compared first: magnitudes of the spectrum, with norm 1; zeros if the picture is plain or unread.

    They are stored among the user's caches for the next command.
    """
    kept = KeptFile.of(path, "copies", [*_SIZE_HW, _SAMPLES], suffix=".f2")
    with suppress(ValueError):
        stored = np.frombuffer(kept.read(), "<f2")
        if stored.shape == (_SAMPLES,) and np.isfinite(stored).all():
            return stored.astype(np.float32)
    found = np.zeros(_SAMPLES, np.float32)
    if not read:
        return found
    if (picture := _decoded(path, max_pixels)) is not None:
        sampled = np.abs(_spectrum(picture))[_sampled_places()]
        found = np.asarray(sampled / max(float(np.linalg.norm(sampled)), 1e-12), np.float32)
        kept.write(found.astype("<f2").tobytes())
    return found


@cache
def _sampled_places() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows, except those near the poles, and frequencies of the spectrum that are compared first."""
    rng = np.random.default_rng(0)
    height, width = _SIZE_HW
    return rng.integers(height // 16, height * 15 // 16, _SAMPLES), rng.integers(2, width // 4, _SAMPLES)


def _spectrum(picture: NDArray[np.uint8]) -> NDArray[np.complex64]:
    margin = _SIZE_HW[1] // 16
    wrapped = np.pad(picture.astype(np.float32), ((0, 0), (margin, margin)), mode="wrap")
    # Coarser structure is alike in all pictures of a place.
    fine = (wrapped - cv2.GaussianBlur(wrapped, (0, 0), 2.0))[:, margin:-margin]
    norm = float(np.linalg.norm(fine))
    is_plain = norm < 0.5 * np.sqrt(fine.size)
    return np.fft.rfft(np.asarray(np.zeros_like(fine) if is_plain else fine / norm, np.float32), axis=1).astype(
        np.complex64
    )


def _reduced(path: Path, max_pixels: int) -> NDArray[np.uint8] | None:
    """Return a picture in grey at `_SIZE_HW`, stored among the user's caches for the next command; None if unread."""
    kept = KeptFile.of(path, "copies", [*_SIZE_HW], suffix=".png")
    if data := kept.read():
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if picture is not None and picture.shape == _SIZE_HW:
            return np.asarray(picture, np.uint8)
    small = _decoded(path, max_pixels)
    if small is not None:
        kept.write(cv2.imencode(".png", small)[1].tobytes())
    return small


def _decoded(path: Path, max_pixels: int) -> NDArray[np.uint8] | None:
    with suppress(InputError):
        data = FilePart(path).read_bytes()
        if holds_floats(data):
            grey = cv2.cvtColor(decode_image(path, data, max_pixels=max_pixels), cv2.COLOR_RGB2GRAY)
            return np.asarray(cv2.resize(grey, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA), np.uint8)
        size_hw = stated_size(data)
        width = size_hw[1] if size_hw is not None else 0
        flags = next((flag for by, flag in _REDUCED.items() if width >= by * _SIZE_HW[1]), cv2.IMREAD_GRAYSCALE)
        decoded = decode_picture(data, path, flags | cv2.IMREAD_IGNORE_ORIENTATION, max_pixels=max_pixels)
        if decoded is not None:
            return np.asarray(cv2.resize(decoded, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return None
