"""Videos made for the tests: what is in a frame tells which one it is."""

from __future__ import annotations

import functools
import os
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from pano_mvs.core.arrays import Picture

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # our own errors replace FFmpeg's messages

_folders: list[TemporaryDirectory[str]] = []
_BITS, _CELL = 8, 8


def counted(number: int, size_hw: tuple[int, int] = (64, 128)) -> Picture:
    """A frame with bright noise and, in cells along its equator, its own number in binary."""
    rng = np.random.default_rng(number // 1000)
    frame = rng.integers(60, 200, (*size_hw, 3)).astype(np.uint8)
    top = size_hw[0] // 2 - _CELL
    for bit in range(_BITS):
        frame[top : top + 2 * _CELL, bit * 2 * _CELL : (bit + 1) * 2 * _CELL] = 255 if number >> bit & 1 else 0
    return frame


def number_of(frame: Picture) -> int:
    """Return the number in a frame."""
    middle = frame.shape[0] // 2
    cells = [frame[middle - 4 : middle + 4, bit * 2 * _CELL + 4 : (bit + 1) * 2 * _CELL - 4] for bit in range(_BITS)]
    return sum(1 << bit for bit, cell in enumerate(cells) if cell.mean() > 127)


def write_video(path: Path, count: int, picture: Callable[[int], Picture] = counted, *, per_s: float = 20.0) -> Path:
    """Write a video of so many frames, .mp4 or .avi."""
    height, width = picture(0).shape[:2]
    codec = cv2.VideoWriter.fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, per_s, (width, height))
    assert writer.isOpened()
    for number in range(count):
        writer.write(picture(number))
    writer.release()
    return path


def retimed(path: Path, durations_s: Sequence[float]) -> None:
    """Give every frame of an .mp4 a duration of its own, in its boxes moov/…/stts and elst (ISO 14496-12)."""
    data = bytearray(path.read_bytes())
    ticks = struct.unpack_from(">I", data, data.find(b"mdhd") + 16)[0]
    deltas = [round(duration * ticks) for duration in durations_s]
    begin, end, parents = 0, len(data), []
    for wanted in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        begin, end = _box(data, begin, end, wanted)
        parents.append(begin - 8)
    table = b"".join(struct.pack(">II", 1, delta) for delta in deltas)
    new = struct.pack(">I4sII", 16 + len(table), b"stts", 0, len(deltas)) + table
    for parent in parents[:-1]:
        size = struct.unpack_from(">I", data, parent)[0]
        struct.pack_into(">I", data, parent, size + len(new) - (end - parents[-1]))
    data[parents[-1] : end] = new
    struct.pack_into(">I", data, data.find(b"elst") + 12, round(sum(durations_s) * 1000) + 1)
    path.write_bytes(data)


def _box(data: bytearray, begin: int, end: int, wanted: bytes) -> tuple[int, int]:
    """Return where the content of a box among others begins and ends."""
    while begin < end:
        size, kind = struct.unpack_from(">I4s", data, begin)
        if kind == wanted:
            return begin + 8, begin + size
        begin += size
    raise AssertionError(f"no box {wanted!r}")


@functools.cache
def tiny_video() -> Path:
    """A video of three seconds that goes when the process ends."""
    _folders.append(TemporaryDirectory(prefix="pano-mvs-video-"))
    return write_video(Path(_folders[-1].name) / "walk.avi", 60)
