"""Copies among the panoramas of a capture: the same picture again, turned about the vertical, resized, or saved again.

A copy shows the world from the same place, so that it adds nothing, but it counts as further evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, StoreError
from pano_mvs.core.files import replacing
from pano_mvs.io.images.keyframe_file import file_of_state
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import MAX_PIXELS, decode_picture
from pano_mvs.scene.image_header import stated_size

_SIZE_HW = (128, 256)
_BLUR_PX = 2.0  # coarser structure is alike in all pictures of a place
# Copies at a quarter of the size, or saved as JPEG of quality 30, have .91 and more; other panoramas .77 and less
# (20 places with up to 44 panoramas, some with a tripod or the same logo in each).
_MIN_CORRELATION = 0.85
_REDUCED = {8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2}


@dataclass(frozen=True)
class Copy:
    """What a picture is a copy of.

    Attributes:
        original: name of the earlier picture.
        turn_deg: how far the copy is turned to the left about the vertical, from 0 to 360.
    """

    original: str
    turn_deg: float


def find_copies(paths: Mapping[str, Path], *, max_pixels: int = MAX_PIXELS) -> dict[str, Copy]:
    """Return, for each picture that is a copy of an earlier one, which one.

    Pictures that OpenCV does not read are compared with none.
    """
    known = {name: picture for name, path in paths.items() if (picture := _reduced(path, max_pixels)) is not None}
    return copies_among(known)


def copies_among(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, Copy]:
    """Return, for each small grey picture (128, 256) that is a copy of an earlier one, which one.

    Two pictures are compared by the largest circular correlation of their fine structure over all turns. By the
    inequality of Cauchy and Schwarz, it is at most the scalar product of the norms of their rows, which turns do not
    change, so that most pairs need no transform.
    """
    if len(pictures) < 2:
        return {}
    names = list(pictures)
    fine = np.array([_fine_structure(picture) for picture in pictures.values()])
    norms = np.linalg.norm(fine, axis=2)
    likely = np.tril(norms @ norms.T >= _MIN_CORRELATION, -1)
    spectra = np.fft.rfft(fine, axis=2).astype(np.complex64)
    found: dict[str, Copy] = {}
    for later in range(len(names)):
        for earlier in np.flatnonzero(likely[later]).tolist():
            if names[earlier] in found:
                continue
            correlation = np.fft.irfft((np.conj(spectra[later]) * spectra[earlier]).sum(axis=0), _SIZE_HW[1])
            best = int(correlation.argmax())
            if correlation[best] >= _MIN_CORRELATION:
                found[names[later]] = Copy(names[earlier], 360 * best / _SIZE_HW[1])
                break
    return found


def _fine_structure(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return a picture without its coarse structure, with norm 1; all zeros if no more than rounding is left of it."""
    margin = _SIZE_HW[1] // 16
    wrapped = np.pad(picture.astype(np.float32), ((0, 0), (margin, margin)), mode="wrap")
    fine = (wrapped - cv2.GaussianBlur(wrapped, (0, 0), _BLUR_PX))[:, margin:-margin]
    norm = float(np.linalg.norm(fine))
    is_plain = norm < 0.5 * np.sqrt(fine.size)
    return np.asarray(np.zeros_like(fine) if is_plain else fine / norm, np.float32)


def _reduced(path: Path, max_pixels: int) -> NDArray[np.uint8] | None:
    """Return a picture in grey at `_SIZE_HW`, stored among the user's caches for the next command; None if unread."""
    kept = file_of_state(path, "copies", [*_SIZE_HW], suffix=".png")
    if kept is not None:
        with suppress(OSError):
            picture = cv2.imdecode(np.fromfile(kept, np.uint8), cv2.IMREAD_GRAYSCALE)
            if picture is not None and picture.shape == _SIZE_HW:
                return np.asarray(picture, np.uint8)
    with suppress(InputError):
        data = FilePart(path).read_bytes()
        size_hw = stated_size(data)
        width = size_hw[1] if size_hw is not None else 0
        flags = next((flag for by, flag in _REDUCED.items() if width >= by * _SIZE_HW[1]), cv2.IMREAD_GRAYSCALE)
        decoded = decode_picture(data, path, flags | cv2.IMREAD_IGNORE_ORIENTATION, max_pixels=max_pixels)
        if decoded is not None:
            small = np.asarray(cv2.resize(decoded, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA), np.uint8)
            _keep(kept, small)
            return small
    return None


def _keep(path: Path | None, picture: NDArray[np.uint8]) -> None:
    if path is not None:
        with suppress(OSError, StoreError), replacing(path) as temporary:
            temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
