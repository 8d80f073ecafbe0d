"""Locks of files: one holder at a time, and none that outlives its process."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pano_mvs.core.locks import locked


def test_one_holds_the_lock_at_a_time(tmp_path: Path) -> None:
    inside, most, waited = [0], [0], list[str]()

    def hold(name: str) -> None:
        with locked(tmp_path / "lock", on_wait=lambda: waited.append(name)):
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            entered.set()
            released.wait(10.0)
            inside[0] -= 1

    entered, released = threading.Event(), threading.Event()
    threads = [threading.Thread(target=hold, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    assert entered.wait(10.0)
    while not waited:
        pass
    released.set()
    for thread in threads:
        thread.join()
    assert (most[0], len(waited)) == (1, 1)


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; from pano_mvs.core.locks import locked\n"
        "with locked(Path(sys.argv[1])): os._exit(9)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "lock")], check=False)
    assert done.returncode == 9
    with locked(tmp_path / "lock", on_wait=lambda: pytest.fail("nobody holds it")):
        pass


def test_a_folder_is_no_lock(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="director"), locked(tmp_path):
        pass
