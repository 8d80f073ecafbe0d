"""Files that are parts of records."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.scene import FilePart


def test_the_sha256_of_a_file_is_that_of_other_programs(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-4, appendix B.1
    assert FilePart(tmp_path / "a").sha256() == expected
