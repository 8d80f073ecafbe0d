"""Decode image files to RGB arrays, and write PNG files."""

from __future__ import annotations

import os
import re
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.exr import EXR_REMEDY, has_exr, read_exr
from pano_mvs.scene.image_header import (
    EXR_START,
    JPEG_START,
    PNG_START,
    TIFF_STARTS,
    Size,
    exr_windows,
    has_alpha,
    holds_floats,
    is_cut_short,
    of_file,
    stated_size,
    stated_size_of_file,
    transparent_grey,
)
from pano_mvs.scene.image_header import MAX_PIXELS as MAX_PIXELS
from pano_mvs.scene.record import FilePart

MASK_BYTES_PER_PIXEL = 8
"""Peak memory while a mask is read and resized: grey levels, flags, and counts of masked pixels."""
ALPHA_BYTES_PER_PIXEL = 18
"""Peak memory while the alpha channel of an image of 16 bits is read: the file, four samples, flags."""


# Our own errors replace OpenCV's messages about images that it cannot decode.
_SILENT = 0
if hasattr(cv2, "setLogLevel"):  # OpenCV 4
    cv2.setLogLevel(_SILENT)
else:
    cv2.utils.logging.setLogLevel(_SILENT)

_COMPRESSED_STARTS = (JPEG_START, PNG_START, *TIFF_STARTS)

_OPENCV_PIXELS, _OPENCV_SIDE = 1 << 30, 1 << 20  # CV_IO_MAX_IMAGE_PIXELS, _WIDTH and _HEIGHT
_OPENCV_NO_MEMORY, _OPENCV_ASSERTION = -4, -215

# libjpeg's warnings about the data. Extraneous bytes before a marker other than a restart marker are harmless: some
# cameras write padding.
_JPEG_WARNING = re.compile(r"(?:Corrupt JPEG data|Premature end of JPEG file|Inconsistent progression sequence).*")
_HARMLESS = re.compile(r".*extraneous bytes before marker 0x(?!d[0-7])..$")
_STDERR = 2
_redirected = threading.Lock()


def decoding_bytes_per_pixel(path: Path) -> int:
    """Return the peak memory in bytes per pixel of decoding an image file, including the file."""
    # Measured worst cases, including the file: floats (HDR); uncompressed TIFF and PNG of 16 bits; JPEG takes 6.
    if of_file(path, holds_floats):
        return 40
    return 18 if path.suffix.lower() in {".tif", ".tiff"} else 8


def decode_picture(data: bytes, path: Path, flags: int, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.generic] | None:
    """Return an image as OpenCV decodes it, BGR, or None if OpenCV does not know its format.

    Args:
        flags: `cv2.IMREAD_…`.
        max_pixels: the limit of pixels, which is compared with the header before memory is allocated.

    Raises:
        InputError: if the image has more pixels than the limit, or than OpenCV or the memory allow, if the header
            states more pixels than the file can contain, or if a JPEG is truncated or damaged.
    """
    size = check_stated_size(data, path, max_pixels)
    if data.startswith(JPEG_START) and is_cut_short(data):
        raise InputError(
            f"{path}: the JPEG ends early (truncated after {len(data)} bytes). Copy it again from the camera"
        )
    if not data:
        return None
    try:
        image, warning = _decoded(data, flags)
    except (cv2.error, MemoryError) as error:
        raise InputError(f"{path}: {_why_not(error, size)}") from error
    if warning:
        raise InputError(
            f"{path}: the JPEG is damaged or its data end early: a part of the image is missing "
            f"(decoder: {warning}). Copy it again from the camera"
        )
    return image


def check_stated_size(data: bytes, path: Path, max_pixels: int = MAX_PIXELS) -> Size | None:
    """Return the (height, width) in an image's header, or None if it cannot be read."""
    size = stated_size(data)
    if size is None:
        return None
    height, width = size
    pixels = height * width
    what = f"{path}: its header states {width}×{height} px ({pixels / 1e6:.0f} megapixels)"
    if pixels > max_pixels:
        raise InputError(
            f"{what}, more than the limit of {max_pixels / 1e6:.0f}. Scale it down; for panoramas, the "
            "source's setting max_megapixels raises the limit"
        )
    if _is_too_short(data, len(data), pixels):
        raise InputError(
            f"{what}, but a file of {len(data)} bytes cannot hold them: it is damaged or cut short. Copy "
            "it again, or export it again"
        )
    return size


def readable_pixels(path: Path, max_pixels: int) -> int:
    """Return the number of pixels that an image file's header states, 0 if it cannot be read or will be refused."""
    height, width = stated_size_of_file(path) or (0, 0)
    pixels = height * width
    try:
        with path.open("rb") as stream:
            refused = pixels > max_pixels or _is_too_short(stream.read(16), path.stat().st_size, pixels)
    except OSError:
        return 0
    return 0 if refused else pixels


def _is_too_short(data: bytes, length: int, pixels: int) -> bool:
    is_compressed = data.startswith(_COMPRESSED_STARTS) or data[4:8] == b"ftyp"
    # Up to 64 megapixels are accepted whatever the size of the file. Above that, a JPEG, PNG or TIFF cannot have more
    # than 10,000 pixels per byte: deflate expands one byte to at most 1032, each with 8 bilevel pixels. HEIC and AVIF
    # could, but not of a photograph.
    return is_compressed and pixels > max(64_000_000, 10_000 * length)


def _decoded(data: bytes, flags: int) -> tuple[NDArray[np.generic] | None, str]:
    """Return the image or None, and the warning of libjpeg about damaged data, for which it substitutes grey."""
    array = np.frombuffer(data, np.uint8)
    if not data.startswith(JPEG_START):
        return cv2.imdecode(array, flags), ""
    messages: list[str] = []
    with _warnings_of_libjpeg(messages):
        image = cv2.imdecode(array, flags)
    return image, next((line for line in messages if not _HARMLESS.fullmatch(line)), "")


@contextmanager
def _warnings_of_libjpeg(messages: list[str]) -> Iterator[None]:
    """Collect the warnings of libjpeg, which it only prints to the error stream of the process.

    The stream is redirected to a file; other output is forwarded afterwards. If redirection fails, nothing is
    collected.
    """
    with _redirected, ExitStack() as stack:
        try:
            original = os.dup(_STDERR)
            stack.callback(os.close, original)
            caught = stack.enter_context(_file_in_memory())
            os.dup2(caught.fileno(), _STDERR)
        except OSError:
            yield
            return
        try:
            yield
        finally:
            os.dup2(original, _STDERR)
        caught.seek(0)
        for line in caught.read().splitlines(keepends=True):
            text = line.decode(errors="replace").strip()
            if _JPEG_WARNING.fullmatch(text):
                messages.append(text)
            else:
                with suppress(OSError):
                    os.write(_STDERR, line)


def _file_in_memory() -> BinaryIO:
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("libjpeg"), "w+b", 0)
    return tempfile.TemporaryFile(buffering=0)


def _why_not(error: Exception, size: Size | None) -> str:
    """Return the message about an image that OpenCV could not decode."""
    height, width = size or (0, 0)
    of = f" of {width}×{height} px ({width * height / 1e6:.0f} megapixels)" if size else ""
    code = error.code if isinstance(error, cv2.error) else _OPENCV_NO_MEMORY
    if code == _OPENCV_ASSERTION and (height * width > _OPENCV_PIXELS or max(height, width) > _OPENCV_SIDE):
        return (
            f"an image{of} is larger than OpenCV decodes, {_OPENCV_PIXELS / 1e6:.0f} megapixels and "
            f"{_OPENCV_SIDE} px on a side. Scale it down"
        )
    if code == _OPENCV_NO_MEMORY:
        return f"there is not enough memory to decode an image{of}. Close other programs, or scale it down"
    states = f" (its header states {width}×{height} px)" if size else ""
    return f"not an image that can be decoded{states}. Copy it again"


_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})


def decode_image(path: Path, data: bytes | None = None, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint8]:
    """Return an image as (H, W, 3) uint8 RGB; EXIF orientation and transparency are ignored.

    16-bit images are scaled; floating-point ones (HDR) are tone-mapped. Only the first page of an image with several
    pages is read.

    Raises:
        InputError: if the file cannot be read, is not an image, is truncated or damaged, is larger than the limit, or
            needs an extra that is not installed.
    """
    if data is None:
        data = FilePart(path).read_bytes()
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS and b"avif" not in data[:64]:
        check_stated_size(data, path, max_pixels)
        return _decode_heic(data, path)
    if data.startswith(EXR_START):
        check_stated_size(data, path, max_pixels)
        return _tone_mapped(_decode_exr(data, path))
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    if not data.startswith(PNG_START):  # whose 16 bits OpenCV reduces to 8 as we do, with half of the memory
        flags |= cv2.IMREAD_ANYDEPTH
    image = decode_picture(data, path, flags, max_pixels=max_pixels)
    if image is None and holds_floats(data):
        # OpenCV converts TIFFs of floats with an alpha channel to colours by no flag, but reads all four channels.
        unchanged = decode_picture(data, path, cv2.IMREAD_UNCHANGED, max_pixels=max_pixels)
        image = unchanged[..., :3] if unchanged is not None and unchanged.shape[2:] == (4,) else None
    if image is None and data[4:12] in (b"ftypavif", b"ftypavis"):
        raise InputError(
            f"{path}: this OpenCV ({cv2.__version__}) cannot read AVIF images, or the file is damaged. Install a "
            "newer opencv-python-headless, or convert it to JPEG"
        )
    if image is None:
        raise InputError(
            f"{path}: not an image that can be decoded ({len(data)} bytes). Remove it or convert it to "
            f"JPEG, or to PNG or TIFF of 8 or 16 bits"
        )
    del data  # frees memory
    if image.dtype == np.uint16:
        np.right_shift(image, 8, out=image)  # programs write 8 bits v in 16 as 257 v or 256 v; both give v
        return np.asarray(image[..., ::-1].astype(np.uint8, order="C"))
    if image.dtype in (np.float32, np.float64):
        with np.errstate(over="ignore"):
            return _tone_mapped(np.asarray(image[..., ::-1], np.float32))
    if image.dtype != np.uint8:
        raise InputError(f"{path}: {image.dtype} images are not supported. Convert it to 8 or 16 bits")
    rgb: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)  # in place
    return rgb


def _decode_heic(data: bytes, path: Path) -> NDArray[np.uint8]:
    """Return a HEIC image as (H, W, 3) uint8 RGB; 10 or 12 bits are scaled."""
    try:
        pillow_heif = import_module("pillow_heif")
    except ImportError as error:
        raise InputError(
            f"{path}: HEIC images need an extra: pip install 'pano-mvs[heic]', or convert it to JPEG"
        ) from error
    try:
        picture = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)
        image = np.array(picture, copy=True)  # a view may not outlive the image
    except (ValueError, EOFError, OSError, RuntimeError, SyntaxError, IndexError) as error:  # index: it has no images
        raise InputError(
            f"{path}: not a HEIC image that can be decoded ({error}). Copy it again, or convert it to JPEG"
        ) from error
    rgb = image[..., :3] if image.ndim == 3 and image.shape[-1] >= 3 else np.atleast_3d(image)[..., :1].repeat(3, -1)
    return np.ascontiguousarray(rgb, dtype=np.uint8)


def _decode_exr(data: bytes, path: Path) -> NDArray[np.float32]:
    """Return the colours of an EXR image, (H, W, 3) RGB."""
    if not has_exr():
        raise InputError(f"{path}: {EXR_REMEDY}, or convert it to JPEG")
    channels = read_exr(path, data)
    if not {"R", "G", "B"} <= set(channels):
        raise InputError(
            f"{path}: has no channels R, G and B, but {', '.join(sorted(channels)) or 'none'}. Export its colours "
            "under these names, or remove it"
        )
    stored, whole = exr_windows(data)
    if stored != whole:
        raise InputError(
            f"{path}: stores only the part {stored} of its picture {whole} (columns and rows). Export all of it"
        )
    return np.stack([channels[name] for name in "RGB"], axis=-1)


_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear RGB, ITU-R BT.709
_MIDDLE_GREY = 0.18
_ROWS_AT_ONCE = 64


def _tone_mapped(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an image of linear colours, (H, W, 3) RGB of any range, as 8-bit sRGB.

    The geometric mean of the luminances becomes middle grey, and each colour c becomes c / (1 + c), as in Reinhard et
    al., Photographic tone reproduction for digital images, 2002, equations 1 to 3. Negative values and NaN are black;
    infinite ones are white.
    """
    mapped = np.empty(linear.shape, np.uint8)
    spans = [slice(first, first + _ROWS_AT_ONCE) for first in range(0, len(linear), _ROWS_AT_ONCE)]
    total, count = 0.0, 0
    with np.errstate(all="ignore"):
        for rows in spans:
            luminances = linear[rows] @ _LUMINANCE
            luminances = luminances[np.isfinite(luminances) & (luminances > 0)]
            total, count = total + float(np.log(luminances).sum(dtype=np.float64)), count + luminances.size
        exposure = np.float32(_MIDDLE_GREY / np.exp(total / count) if count else 1.0)
        for rows in spans:
            scaled = np.fmax(linear[rows], 0) * exposure
            shown = 1 - 1 / (1 + scaled)
            srgb = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** np.float32(1 / 2.4) - 0.055)
            mapped[rows] = np.rint(255 * srgb)
    return mapped


def decode_opacity(path: Path, data: bytes, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.bool_] | None:
    """Return where an image is not transparent, (H, W) bool; None if it is opaque, or does not say.

    Raises:
        InputError: as `decode_picture`.
    """
    if not has_alpha(data):
        return None
    picture = decode_picture(data, path, cv2.IMREAD_UNCHANGED, max_pixels=max_pixels)
    if picture is None:
        return None
    if picture.ndim == 2 and (level := transparent_grey(data)) is not None:
        shown = np.asarray(picture != level)
    elif picture.ndim == 3 and picture.shape[2] in (2, 4):
        shown = np.asarray(picture[..., -1] != 0)
    else:
        return None
    return None if shown.all() else shown


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image, (H, W) grey or (H, W, 3) RGB uint8, as PNG."""
    ordered = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(".png", ordered)[1].tobytes())
