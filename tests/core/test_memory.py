"""The memory of this host, as the system and the container state it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.core import memory
from pano_mvs.core.memory import free_memory_bytes, total_memory_bytes


def test_some_of_the_memory_is_free() -> None:
    assert 0 < free_memory_bytes() < total_memory_bytes()


@pytest.mark.skipif(not Path("/proc/meminfo").is_file(), reason="of Linux")
def test_a_container_limits_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_CONTAINER", tmp_path)
    (tmp_path / "memory.max").write_text("50000000\n")
    (tmp_path / "memory.current").write_text("30000000\n")
    (tmp_path / "memory.stat").write_text("anon 20000000\ninactive_file 5000000\n")
    assert total_memory_bytes() == 50_000_000
    assert free_memory_bytes() == 25_000_000
    (tmp_path / "memory.max").write_text("max\n")
    assert total_memory_bytes() > 50_000_000
    assert free_memory_bytes() > 50_000_000
