"""Questions about paths have answers, whatever the path; and nothing else in the package asks the system."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pano_mvs
from pano_mvs.core import paths
from tests.permissions import drop_right_to_ignore_permissions, permissions_hold

PACKAGE = Path(pano_mvs.__file__).parent
RAISING = {
    "is_file",
    "is_dir",
    "exists",
    "is_symlink",
    "resolve",
    "expanduser",
    "iterdir",
    "glob",
    "rglob",
    "samefile",
    "home",
    "cwd",
}
# `Resolver.resolve` resolves a stage, `blobs.exists` takes a reference, the entries of os.scandir know what they are;
# what a plugin's code is, is asked where any error is the plugin's.
NOT_OF_PATHS = {
    ("engine/planning/unit_keys.py", "resolve"),
    ("engine/cache/maintenance.py", "is_file"),
    ("engine/cache/maintenance.py", "is_dir"),
}
EXEMPT = {"core/paths.py", "engine/stages/stage_code.py"}


@pytest.fixture(params=["denied", "long", "circle", "null"])
def hostile(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    (tmp_path / "locked").mkdir(mode=0)
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    names = {"denied": "locked/x", "long": "n" * 300, "circle": "circle", "null": "a\0b"}
    return tmp_path / names[request.param]


def test_nothing_raises(hostile: Path) -> None:
    with permissions_hold():
        assert not paths.is_file(hostile)
        assert not paths.is_folder(hostile)
        assert not paths.exists(hostile)
        assert paths.is_link(hostile) == (hostile.name == "circle")
        assert paths.stat_of(hostile) is None
        assert paths.problem_of(hostile)
        assert paths.is_denied(hostile) == (hostile.name == "x")
        assert paths.resolved(hostile).is_absolute()
        assert paths.children(hostile) == paths.below(hostile) == []


def test_what_is_there_is_told_apart(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.txt").touch()
    (tmp_path / "a.txt").touch()
    assert paths.is_file(tmp_path / "a.txt")
    assert paths.is_folder(tmp_path / "b")
    assert paths.problem_of(tmp_path / "a.txt") == ""
    assert paths.problem_of(tmp_path / "gone") == "No such file or directory"
    assert paths.children(tmp_path, "*.txt") == [tmp_path / "a.txt"]
    assert paths.below(tmp_path, "*.txt") == [tmp_path / "a.txt", tmp_path / "b" / "c.txt"]
    assert paths.resolved(tmp_path / "b" / ".." / "a.txt") == tmp_path.resolve() / "a.txt"


def test_home_folder_that_may_not_be_searched_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    assert paths.home_folder() == tmp_path
    tmp_path.chmod(0)
    with permissions_hold():
        assert paths.home_folder() is None
    tmp_path.chmod(0o700)


def test_nothing_else_in_the_package_asks_about_paths() -> None:
    """`Path.is_file` and its like raise in some places: use the functions of `pano_mvs.core.paths`."""
    found = []
    calls = re.compile(rf"\.({'|'.join(RAISING)})\(")
    for file in sorted(PACKAGE.rglob("*.py")):
        name = file.relative_to(PACKAGE).as_posix()
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if name not in EXEMPT and calls.search(text) else ():
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            called, of = node.func.attr, ast.unparse(node.func.value)
            is_of_blobs = called == "exists" and (
                of.endswith("blobs") or (of, name) == ("self", "engine/cache/blobs.py")
            )
            if called in RAISING and not is_of_blobs and (name, called) not in NOT_OF_PATHS:
                found.append(f"{name}:{node.lineno}: {of}.{called}()")
    assert found == []


@pytest.mark.skipif(os.name != "posix", reason="permissions as POSIX has them")
def test_commands_start_where_the_home_folder_may_not_be_searched(tmp_path: Path) -> None:
    """`pano-mvs plugins` crashed, and kernels could not be compiled for want of a folder."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PANO_MVS", "XDG", "NUMBA"))
    }
    (tmp_path / "home").mkdir(mode=0)
    (tmp_path / "tmp").mkdir()
    environment |= {
        "TMPDIR": str(tmp_path / "tmp"),
        "HOME": str(tmp_path / "home"),
        "XDG_CACHE_HOME": str(tmp_path / "home" / "a"),
        "XDG_CONFIG_HOME": str(tmp_path / "home" / "b"),
    }
    code = """
import os
import pano_mvs.algorithms
from pano_mvs.core.plugin_folders import plugin_files_in, user_plugin_folders
os.makedirs(os.environ["NUMBA_CACHE_DIR"])
print([plugin_files_in(folder) for folder in user_plugin_folders()], os.environ["NUMBA_CACHE_DIR"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=drop_right_to_ignore_permissions,
    )
    assert done.stdout.startswith("[[]] "), done.stderr
    assert Path(done.stdout.split()[1]).is_relative_to(tmp_path / "tmp")
