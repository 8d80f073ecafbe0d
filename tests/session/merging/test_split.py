"""Blocks are folders of links to the images of a capture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.session.merging.block_runs import Division, split_images


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "walk"
    (folder / "masks").mkdir(parents=True)
    (folder / "masks/1.png").write_bytes(b"mask")
    for number in range(1, 31):
        (folder / f"{number}.png").write_bytes(str(number).encode())
    return folder


def test_blocks_are_links_in_natural_order(images: Path, tmp_path: Path) -> None:
    blocks = split_images(images, tmp_path / "blocks", Division(12, 4))
    assert [block.folder.name for block in blocks] == ["block_1", "block_2", "block_3", "block_4"]
    assert blocks[0].names[:3] == ("1.png", "2.png", "3.png")
    assert set(blocks[0].names[-4:]) == set(blocks[1].names[:4])
    for block in blocks:
        assert sorted(path.name for path in block.folder.iterdir()) == sorted([*block.names, "masks"])
        assert all((block.folder / name).read_bytes() == name.removesuffix(".png").encode() for name in block.names)
        assert (block.folder / "masks/1.png").read_bytes() == b"mask"


def test_rough_poses_show_where_the_path_returns(images: Path, tmp_path: Path) -> None:
    along = [*range(15), *range(14, -1, -1)]
    views = [
        {"image": f"{number}.png", "R": np.eye(3).tolist(), "t": [-x, 0, 0]} for number, x in enumerate(along, start=1)
    ]
    (tmp_path / "poses.json").write_text(json.dumps({"metric": True, "views": views}))
    blocks = split_images(images, tmp_path / "blocks", Division(12, 4, poses=tmp_path / "poses.json"))
    assert len(set(blocks[0].names) & set(blocks[-1].names)) >= 3
    (tmp_path / "poses.json").write_text(json.dumps({"views": [views[0] | {"image": "other.png"}]}))
    with pytest.raises(InputError, match="none of its images is one of this capture"):
        split_images(images, tmp_path / "again", Division(12, 4, poses=tmp_path / "poses.json"))


def test_folders_and_sizes_that_cannot_be_used(images: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="its 30 images fit into one block of 100"):
        split_images(images, tmp_path / "blocks", Division(100, 4))
    with pytest.raises(UsageError, match="is in the folder of the images"):
        split_images(images, images / "blocks", Division(12, 4))
    with pytest.raises(UsageError, match="exists and is not an empty folder"):
        split_images(images, tmp_path / "walk/masks", Division(12, 4))
