"""Images and masks are used only with the bytes that were listed, and are read once for that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.api import FilePart, SourceItem
from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import ChangedFileError, InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import Panorama
from pano_mvs.stages.source import FolderParams, folder, list_folder
from tests.stored import read_picture


@pytest.fixture
def item(tmp_path: Path) -> SourceItem:
    """An image with a mask, as the engine hands it out."""
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png", "masks/a.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), rng.integers(1, 255, (32, 64, 3), dtype=np.uint8))
    first = next(iter(list_folder(FolderParams(path=tmp_path, masks=tmp_path / "masks"))))
    assert sorted(first.files) == ["image", "mask"]
    return replace(first, digests={role: digest_from_file(path) for role, path in first.files.items()})


def read(item: SourceItem) -> Panorama:
    context = Context(np.random.default_rng(0), Path(), 1)
    made = folder(item, FolderParams(path=item.files["image"].parent), context)
    assert isinstance(made, Panorama)
    return made


@pytest.mark.parametrize("use", [read, lambda item: read(item).load()], ids=["listed", "loaded"])
def test_files_are_read_once(
    item: SourceItem, use: Callable[[SourceItem], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: Counter[str] = Counter()
    original = Path.read_bytes

    def counted(path: Path) -> bytes:
        reads[path.name if path.parent.name != "masks" else "mask"] += 1
        return original(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    use(item)
    times = 1 if use is read else 2  # the source, then `load`
    assert reads == {"a.png": times, "mask": times}


@pytest.mark.parametrize("role", ["image", "mask"])
def test_file_that_is_not_the_listed_one_is_refused(item: SourceItem, role: str) -> None:
    panorama = read(item)
    assert panorama.image.digest
    path = item.files[role]
    other = read_picture(path)
    other[0, 0] ^= 1
    cv2.imwrite(str(path), other)
    with pytest.raises(ChangedFileError, match=rf"{path.name} changed during the run; run again") as caught:
        read(item)
    assert caught.value.path == path
    with pytest.raises(ChangedFileError, match=rf"{path.name} changed during the run; run again"):
        panorama.load()
    path.unlink()
    with pytest.raises(InputError, match=rf"{path.name}: cannot be read \(No such file"):
        panorama.load()


def test_a_part_without_a_digest_is_read_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    assert FilePart(tmp_path / "a", external=True).read_bytes() == b"1"
    with pytest.raises(InputError, match="cannot be read"):
        FilePart(tmp_path / "a\0b").read_bytes()
