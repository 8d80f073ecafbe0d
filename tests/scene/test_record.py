"""Files that are parts of records."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import ChangedFileError, InputError
from pano_mvs.scene import FilePart


def test_the_sha256_of_a_file_is_that_of_other_programs(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-4, appendix B.1
    assert FilePart(tmp_path / "a").sha256() == expected


def test_a_changed_or_missing_file_has_none(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    part = FilePart(tmp_path / "a", external=True, digest=digest_from_bytes(b"before"))
    with pytest.raises(ChangedFileError, match="changed during the run"):
        part.sha256()
    with pytest.raises(InputError, match="cannot be read"):
        FilePart(tmp_path / "b").sha256()
