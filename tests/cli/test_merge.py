"""`pano-mvs merge` prints how well blocks agree, and what it wrote."""

from __future__ import annotations

from pathlib import Path

from tests.algorithms.blocks.walked_blocks import some_world
from tests.cli.conftest import Command
from tests.session.merging.written_blocks import write_block


def test_merge_prints_the_agreement_and_what_it_wrote(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 0, result.text
    words = result.text.split()
    assert "20 cameras," in result.text
    assert "20 range maps, cloud of 3,000 points" in " ".join(words)
    assert str(tmp_path / "both" / "report.html") in "".join(words)


def test_merge_of_blocks_without_overlap_ends_with_the_reason(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(10)), some_world(1))
    write_block(tmp_path / "two", list(range(10, 20)), some_world(2))
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 2
    assert "3 are needed" in " ".join(result.text.split())


def test_split_prints_the_commands_that_follow(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for number in range(20):
        (tmp_path / f"walk/{number}.png").write_bytes(b"x")
    result = pano_mvs("split", tmp_path / "walk", "--out", tmp_path / "blocks", "--size", "12", "--overlap", "4")
    assert result.code == 0, result.text
    assert "--out out/block_2" in result.text
    assert "then: pano-mvs merge out/block_1 out/block_2 --out out/merged" in " ".join(result.text.split())
    assert (tmp_path / "blocks/block_2/19.png").read_bytes() == b"x"
