"""A capture is divided into overlapping blocks, and blocks with common cameras come into one world."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.algorithms.blocks import (
    BlockAlignment,
    align_blocks,
    divide_capture,
    merge_blocks,
    similarity_from_cameras,
)
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from tests.algorithms.blocks.walked_blocks import bent, block_of, some_world, walk
from tests.scene.pose_groups import drawn_group

NAMES = [f"{idx:03d}.png" for idx in range(200)]


@given(count=st.integers(1, 200), size=st.integers(7, 80), overlap=st.integers(3, 30))
def test_blocks_cover_all_images_and_overlap(count: int, size: int, overlap: int) -> None:
    if 2 * overlap >= size:
        return
    blocks = divide_capture(NAMES[:count], size=size, overlap=overlap)
    assert sorted({name for block in blocks for name in block}) == NAMES[:count]
    assert max(map(len, blocks)) <= size
    for block, following in pairwise(blocks):
        assert len(set(block) & set(following)) == overlap
        assert block == sorted(block)


def test_a_loop_overlaps_at_its_ends() -> None:
    blocks = divide_capture(NAMES[:60], size=25, overlap=5, loop=True)
    assert len(set(blocks[-1]) & set(blocks[0])) == 5
    assert max(map(len, blocks)) <= 25


def test_blocks_share_images_where_the_path_returns() -> None:
    """The path goes to and fro: its end is beside its beginning."""
    along = np.concatenate([np.arange(50), np.arange(50)[::-1]])
    places = {
        name: np.array((x, 0.0, 0.3 * (idx >= 50))) for idx, (name, x) in enumerate(zip(NAMES, along, strict=False))
    }
    plain = divide_capture(NAMES[:100], size=40, overlap=6)
    closed = divide_capture(NAMES[:100], size=40, overlap=6, positions=places)
    assert len(plain) == len(closed) == 3
    assert not set(plain[0]) & set(plain[2])
    assert all(set(before) <= set(after) for before, after in zip(plain, closed, strict=True))
    assert all(len(set(after) - set(before)) <= 6 for before, after in zip(plain, closed, strict=True))
    assert len(set(closed[0]) - set(plain[0]) - set(plain[1])) == 3
    assert len(set(closed[0]) & set(plain[1]) - set(plain[0])) == 3, "the next block comes back, too"


def test_settings_that_cannot_work() -> None:
    with pytest.raises(UsageError, match="an overlap of 2 is too small"):
        divide_capture(NAMES, size=20, overlap=2)
    with pytest.raises(UsageError, match="less than half of the size of a block, 20"):
        divide_capture(NAMES, size=20, overlap=10)


def merged(blocks: list[dict[str, Rigid3]], alignment: BlockAlignment) -> dict[str, Rigid3]:
    found: dict[str, Rigid3] = {}
    for block, similarity in zip(blocks, alignment.world_from_block, strict=True):
        assert similarity is not None
        found |= {name: similarity.move_camera(pose) for name, pose in block.items()}
    return found


def worst_offset(found: dict[str, Rigid3], truth: dict[str, Rigid3]) -> float:
    return max(float(np.linalg.norm(found[name].center - truth[name].center)) for name in found)


def test_blocks_come_into_the_world_of_the_reference() -> None:
    cameras = walk(30)
    ranges = [range(12), range(8, 20), range(16, 30)]
    blocks = [block_of(cameras, list(chosen), some_world(number)) for number, chosen in enumerate(ranges)]
    alignment = align_blocks(blocks, reference=1)
    truth = {name: some_world(1).move_camera(pose) for name, pose in cameras.items()}
    found = merged(blocks, alignment)
    assert len(found) == 30
    assert worst_offset(found, truth) < 1e-6
    for name, pose in found.items():
        np.testing.assert_allclose(pose.rotation, truth[name].rotation, atol=1e-7)
    assert [(link.first, link.second, len(link.names)) for link in alignment.links] == [(0, 1, 4), (1, 2, 4)]
    assert max(link.relative_offset for link in alignment.links) < 1e-6


def test_orientations_settle_the_rotation_about_a_line() -> None:
    cameras = walk(20, line=True)
    blocks = [block_of(cameras, list(range(12)), some_world(0)), block_of(cameras, list(range(8, 20)), some_world(1))]
    truth = {name: some_world(0).move_camera(pose) for name, pose in cameras.items()}
    assert worst_offset(merged(blocks, align_blocks(blocks)), truth) < 1e-6


def test_a_few_cameras_with_wrong_poses_do_no_harm() -> None:
    cameras = list(walk(12).values())
    world = some_world(3)
    moved = [world.move_camera(pose) for pose in cameras]
    for idx in (2, 5, 9):
        moved[idx] = Rigid3.from_center(rotation_from_rotvec((1, 2, 0)) @ moved[idx].rotation, moved[idx].center + 4.0)
    found = similarity_from_cameras(cameras, moved)
    assert found.scale == pytest.approx(world.scale, rel=1e-4)
    np.testing.assert_allclose(found.apply(np.eye(3)), world.apply(np.eye(3)), atol=1e-3 * world.scale)


def test_a_loop_of_blocks_shares_its_error() -> None:
    """Chained one by one, the last block would not meet the first."""
    cameras = walk(40)
    ranges = [range(10 * number, 10 * number + 14) for number in range(4)]
    blocks = []
    for number, chosen in enumerate(ranges):
        own = block_of(cameras, list(chosen), some_world(8))
        blocks.append(block_of(bent(own, turn_deg=1.0, stretch=0.01), list(range(len(own))), some_world(number)))
    alignment = align_blocks(blocks)
    assert len(alignment.links) == 4
    offsets = [link.relative_offset for link in alignment.links]
    assert max(offsets) < 0.05
    chained = align_blocks([*blocks[:3], {name: pose for name, pose in blocks[3].items() if name not in blocks[0]}])
    gap = [
        np.linalg.norm(chained.world_from_block[3].apply(blocks[3][name].center) - blocks[0][name].center)
        for name in blocks[0]
        if name in blocks[3] and chained.world_from_block[3] is not None
    ]
    first_and_last = next(link for link in alignment.links if (link.first, link.second) == (0, 3))
    assert np.median(gap) > 2 * np.median(first_and_last.offsets)


def test_disagreement_shows_in_the_links() -> None:
    cameras = walk(20)
    crooked = bent(block_of(cameras, list(range(8, 20)), some_world(1)), turn_deg=60, stretch=0.3)
    (link,) = align_blocks([block_of(cameras, list(range(14)), some_world(0)), crooked]).links
    assert link.relative_offset > 0.02
    assert link.turn_deg > 1


def test_a_block_with_too_few_common_cameras_is_left_out() -> None:
    cameras = walk(20)
    blocks = [block_of(cameras, list(range(12)), some_world(0)), block_of(cameras, list(range(10, 20)), some_world(1))]
    alignment = align_blocks(blocks)
    assert alignment.world_from_block[1] is None
    assert alignment.links == ()


def test_each_camera_keeps_what_its_own_block_knows_of_it() -> None:
    first = replace(drawn_group(("a", "b", "c"), seed=1), right_probabilities=np.array([0.1, 0.2, 0.3]))
    second = drawn_group(("c", "d", "e"), seed=2)
    merged = merge_blocks([first, second], [Similarity3(1.0, np.eye(3), np.zeros(3))] * 2, order="abcde", reference=0)
    of_first = merged.owner == 0
    assert merged.poses.right_probabilities is not None
    assert np.isnan(merged.poses.right_probabilities).tolist() == (~of_first).tolist()
    np.testing.assert_array_equal(merged.poses.right_probabilities[:2], [0.1, 0.2])
    assert merged.poses.evidence.get("c") == (None if of_first[2] else second.evidence["c"])
    assert merged.poses.evidence["a"] == first.evidence["a"]
    assert merged.poses.doubts["e"] == second.doubts["e"]
    assert merged.poses.center_stds is None
