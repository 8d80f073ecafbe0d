"""Pictures that were decoded already are neither decoded again, nor mixed up, nor changed by who got them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene import panorama as module
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.scene.panorama import RecentPictures


def picture(level: int, rows: int = 4) -> np.ndarray:
    return np.full((rows, 2 * rows, 3), level, np.uint8)


def test_the_least_recently_used_are_dropped() -> None:
    recent = RecentPictures(limit_bytes=4 * picture(0).nbytes)
    for level in range(4):
        recent.put(level, picture(level))
    assert recent.get(0) is not None
    recent.put(4, picture(4))
    assert recent.get(1) is None
    for level in (0, 2, 3, 4):
        kept = recent.get(level)
        assert kept is not None
        np.testing.assert_array_equal(kept, picture(level))


def test_large_pictures_are_not_kept() -> None:
    recent = RecentPictures(limit_bytes=4 * picture(0).nbytes)
    recent.put("small", picture(1))
    recent.put("large", picture(2, 5))
    assert recent.get("large") is None
    assert recent.get("small") is not None


def test_a_panorama_is_decoded_once_until_its_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_RECENT", RecentPictures(1 << 20))
    decoded: list[Path] = []

    def decode(path: Path, data: bytes, *, max_pixels: int) -> np.ndarray:
        decoded.append(path)
        return decode_image(path, data, max_pixels=max_pixels)

    monkeypatch.setattr(module, "decode_image", decode)
    write_png(tmp_path / "a.png", picture(10, 16))
    panorama = Panorama(FilePart(tmp_path / "a.png"), (16, 32), (16, 32))
    first = panorama.load()
    first[:] = 99
    assert (panorama.load() == 10).all()
    assert (Panorama(FilePart(tmp_path / "a.png"), (8, 16), (16, 32)).load() == 10).all()
    assert len(decoded) == 2  # once for each size
    write_png(tmp_path / "a.png", picture(20, 16))
    assert (panorama.load() == 20).all()
