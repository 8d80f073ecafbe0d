from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from pano_mvs.core import kernel_cache


def test_folder_changes_with_any_kernel_file(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "kernels_a.py").write_text("a = 1")
    first = kernel_cache.kernel_cache_folder(tmp_path)
    (tmp_path / "other.py").write_text("b = 1")
    assert kernel_cache.kernel_cache_folder(tmp_path) == first
    (tmp_path / "inner" / "kernels_a.py").write_text("a = 2")
    assert kernel_cache.kernel_cache_folder(tmp_path) != first


def test_folder_that_the_user_has_chosen_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernel_cache.VARIABLE, "mine")
    kernel_cache.use_kernel_cache(tmp_path)
    assert os.environ[kernel_cache.VARIABLE] == "mine"


CALL = """
import numpy as np
from numba import config
from pano_mvs.algorithms.filters.speckle import remove_speckles
from pano_mvs.scene import RangeMap
remove_speckles(RangeMap(np.ones((8, 16), np.float32), np.full((8, 16), 99, np.uint8)))
print(config.CACHE_DIR)
"""


@pytest.mark.parametrize("first", ["", "import numba\n"])
def test_kernels_are_kept_there_whichever_is_imported_first(tmp_path: Path, first: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != kernel_cache.VARIABLE}
    environment["XDG_CACHE_HOME"] = environment["LOCALAPPDATA"] = str(tmp_path)
    command = [sys.executable, "-c", first + CALL]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    folder = Path(done.stdout.strip())
    if sys.platform != "darwin":
        assert folder.is_relative_to(tmp_path)
    assert folder.is_dir()


@pytest.mark.skipif(sys.platform == "win32", reason="permissions as POSIX has them")
def test_kernels_that_others_could_have_written_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    folder = kernel_cache._own_temporary_folder()
    assert kernel_cache._own_temporary_folder() == folder
    folder.chmod(0o770)
    with pytest.raises(OSError, match="no writable folder for caches"):
        kernel_cache._own_temporary_folder()
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="no writable folder for caches"):
        kernel_cache._own_temporary_folder()
