from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from pano_mvs.core import kernel_cache
from pano_mvs.core.kernels import kernel


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


def test_folder_changes_with_the_kernels_of_every_layer(tmp_path: Path) -> None:
    copy = tmp_path / "pano_mvs"
    shutil.copytree(kernel_cache.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    folder = kernel_cache.kernel_cache_folder()
    assert kernel_cache.kernel_cache_folder(copy) == folder
    with (copy / "geometry" / "kernels_sphere.py").open("a") as file:
        file.write("# edited\n")
    assert kernel_cache.kernel_cache_folder(copy) != folder


CALL = """
from numba import config
from pano_mvs.core.kernel_cache import kernel_cache_folder
from pano_mvs.{module} import {kernel}
{call}
print(config.CACHE_DIR)
assert config.CACHE_DIR == str(kernel_cache_folder())
"""
KERNELS = {
    "geometry.kernels_sphere": ("wrapped_row", "wrapped_row(-1, 4)"),
    "algorithms.filters.kernels_fill": ("_root", "import numpy; _root(numpy.arange(8), 3)"),  # quickly compiled
}


@pytest.mark.slow
@pytest.mark.parametrize(("first", "module"), [*zip(("", "import numba\n"), KERNELS, strict=True)])
def test_kernels_are_kept_there_whichever_is_imported_first(tmp_path: Path, first: str, module: str) -> None:
    kernel, call = KERNELS[module]
    environment = {key: value for key, value in os.environ.items() if key != kernel_cache.VARIABLE}
    environment["XDG_CACHE_HOME"] = environment["LOCALAPPDATA"] = str(tmp_path)
    command = [sys.executable, "-c", first + CALL.format(module=module, kernel=kernel, call=call)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    folder = Path(done.stdout.strip())
    if sys.platform != "darwin":
        assert folder.is_relative_to(tmp_path)
    assert list(folder.rglob("*.nbi"))


COMPILE = """
import numpy
from pano_mvs.algorithms.filters.kernels_fill import label_surfaces
from pano_mvs.core.kernel_cache import compilation_time, count_compiled
print("ready", flush=True)
label_surfaces(numpy.ones((8, 16), numpy.float32), 1.0)
print(sum(label_surfaces.stats.cache_misses.values()), count_compiled() > 0, compilation_time.seconds > 0.1)
"""


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """An environment with an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return {key: value for key, value in os.environ.items() if key != kernel_cache.VARIABLE}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kernel files are not locked there")
def test_processes_that_need_the_same_kernel_compile_it_once(environment: dict[str, str]) -> None:
    import fcntl

    folder = kernel_cache.kernel_cache_folder() / "pano_mvs.algorithms.filters.kernels_fill"
    folder.mkdir(parents=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = [sys.executable, "-c", COMPILE]
        started = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        for process in started:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
    assert sorted(process.communicate()[0] for process in started) == ["0 True True\n", "1 True True\n"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="another variable names the folder for caches")
def test_copies_share_kernels_until_one_is_edited(tmp_path: Path, environment: dict[str, str]) -> None:
    """Even where the edited copy inherits the folder of the other one, and the edit is in another file."""
    shutil.copytree(kernel_cache.PACKAGE, tmp_path / "pano_mvs", ignore=shutil.ignore_patterns("__pycache__"))
    edited = tmp_path / "pano_mvs" / "geometry" / "kernels_sphere.py"

    def misses() -> str:
        command = [sys.executable, "-c", COMPILE]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()[1]

    subprocess.run([sys.executable, "-c", COMPILE], env=environment, capture_output=True, check=True)
    assert misses() == "0"
    environment[kernel_cache.VARIABLE] = str(kernel_cache.kernel_cache_folder())
    edited.write_text(f"{edited.read_text(encoding='utf-8')}# edited\n", encoding="utf-8")
    assert misses() == "1"


@pytest.mark.slow
def test_a_kernel_outside_the_package_is_compiled_again_after_an_edit(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    """The digest of the files of the package says nothing of it.

    Python's own compiled files are left out (`-B`): they know edits only by the second and the size.
    """
    for factor in ("2.0", "3.0"):
        text = f"from pano_mvs.core.kernels import kernel\n@kernel\ndef scaled(x):\n    return {factor} * x\n"
        (tmp_path / "outside.py").write_text(text)
        command = [sys.executable, "-B", "-c", "import pano_mvs.algorithms, outside; print(outside.scaled(1.0))"]
        paths = os.pathsep.join([str(tmp_path), str(kernel_cache.PACKAGE.parent)])
        done = subprocess.run(command, env=environment | {"PYTHONPATH": paths}, stdout=subprocess.PIPE, check=True)
        assert float(done.stdout) == float(factor)


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


@kernel
def _scaled(value: float, factor: int) -> float:
    return value * factor


@kernel
def _scaled_twice(value: float, factor: int) -> float:
    return float(_scaled(value, factor) + _scaled(value, 3))


def test_a_call_with_a_constant_compiles_no_further_copy() -> None:
    assert _scaled_twice(2.0, 4) == 14.0
    assert len(_scaled.overloads) <= 1  # none if the caller comes from the disk
