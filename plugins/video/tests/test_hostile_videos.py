"""No content of a video leads to anything but an error that names it."""

from __future__ import annotations

from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from pano_mvs_video.video_files import _movie_header, describe_video, frames_between

from pano_mvs.api import InputError
from pano_mvs.scene.image_file import MAX_PIXELS
from tests.io.images.test_hostile_metadata import CHANGES, with_hostile_fields


@cache
def video() -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder, "video.mp4")
        form: Any = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(path), form, 5.0, (128, 64))
        for number in range(6):
            writer.write(np.full((64, 128, 3), 40 * number, np.uint8))
        writer.release()
        return path.read_bytes()


@pytest.mark.slow
@given(CHANGES)
@settings(max_examples=150, deadline=None)
def test_any_boxes_of_a_video_are_read(changes: list[tuple[int, int, int, int]]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "video.mp4")
        path.write_bytes(with_hostile_fields(video(), changes))
        try:
            describe_video(path)
            for _, frame in islice(frames_between(path, 0.0, 10.0), 10):
                assert frame.size <= 3 * MAX_PIXELS
        except InputError as error:
            assert str(path) in str(error)  # noqa: PT017


@pytest.mark.parametrize("size", [0, 15, 2**40, 2**64 - 1])
def test_a_box_may_state_any_size(tmp_path: Path, size: int) -> None:
    """The position behind it may be none that a file can have."""
    path = tmp_path / "video.mp4"
    path.write_bytes(b"\0\0\0\1free" + size.to_bytes(8, "big") + bytes(64))
    assert _movie_header(path) == b""
