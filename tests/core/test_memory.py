"""The memory of this host, as the system and the container state it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import typer

from pano_mvs.cli.endings import guarded
from pano_mvs.core import memory
from pano_mvs.core.errors import RunStoppedError
from pano_mvs.core.memory import free_memory_bytes, require_address_space, total_memory_bytes


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


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_too_small_an_address_space_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """With less, a library did not end to load, and the command waited for ever."""
    import resource

    limit = resource.RLIM_INFINITY
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limit, limit))
    require_address_space()
    limit = 2 * 10**9
    require_address_space()
    limit = 300_000_000
    with pytest.raises(RunStoppedError, match=r"at most 300.0 MB of address space \(`ulimit -v`\)"):
        require_address_space()


def test_memory_that_runs_out_is_no_bug(capsys: pytest.CaptureFixture[str]) -> None:
    @guarded
    def command() -> None:
        raise MemoryError

    with pytest.raises(typer.Exit) as end:
        command()
    assert end.value.exit_code == 4
    said = " ".join(capsys.readouterr().err.split())
    assert "no memory is left" in said
    assert "Use fewer --workers" in said
