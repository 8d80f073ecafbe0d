"""What is built for people to install holds all that a run needs, and works where there is no checkout."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from tests.cli.conftest import made_once, of_all_processes

__all__ = ["of_all_processes"]  # a fixture

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


def build(root: Path, target: str, folder: Path) -> Path:
    """Build with the backend that pyproject.toml names; it needs no network."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    subprocess.run(command, cwd=root, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built


def built_once(target: str, folder: Path) -> Path:
    """Return what is built of the checkout, once in a test run; `folder` is shared by its processes."""

    def make(place: Path) -> None:
        build(ROOT, target, place)

    (built,) = made_once(folder / f"built-{target}", make).iterdir()
    return built


@pytest.fixture(scope="module")
def wheel(of_all_processes: Path) -> Path:
    return built_once("wheel", of_all_processes)


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def below(folder: Path, pattern: str) -> set[str]:
    files = (path for path in folder.rglob(pattern) if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in files}


def test_the_wheel_holds_all_of_the_package(names: set[str]) -> None:
    package = {f"pano_mvs/{name}" for name in below(ROOT / "pano_mvs", "*")}
    ours = {name for name in below(ROOT / "workflows", "*") if not name.startswith(".")}  # no cache of theirs
    workflows = {f"pano_mvs/workflows/{name}" for name in ours}
    inside = {name for name in names if name.startswith("pano_mvs/")}
    assert inside == package | workflows
    assert {
        "pano_mvs/py.typed",
        "pano_mvs/__main__.py",
        "pano_mvs/workflows/quickstart.yaml",
        "pano_mvs/workflows/samples/classroom/images/000.png",
        "pano_mvs/workflows/samples/classroom/ATTRIBUTION.md",
    } <= inside
    assert any(name.endswith(".py.jinja") for name in inside)
    assert any("report/templates/" in name for name in inside)
    assert not [name for name in names if name.startswith(("tests", "plugins", "docs"))]


def test_licences_and_metadata(wheel: Path, names: set[str]) -> None:
    (folder,) = {name.partition("/")[0] for name in names if ".dist-info/" in name}
    samples = {path.parent.name for path in (ROOT / "workflows" / "samples").glob("*/ATTRIBUTION.md")}
    kept = {f"{folder}/licenses/LICENSE"}
    kept |= {f"{folder}/licenses/workflows/samples/{sample}/ATTRIBUTION.md" for sample in samples}
    assert kept <= names
    with zipfile.ZipFile(wheel) as archive:
        metadata = Parser().parsestr(archive.read(f"{folder}/METADATA").decode())
        assert b"pano-mvs = pano_mvs.cli.app:main" in archive.read(f"{folder}/entry_points.txt")
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.11"
    assert {"dask", "heic"} <= set(metadata.get_all("Provides-Extra") or ())
    assert str(metadata.get_payload()).startswith("# pano_mvs")


def test_the_source_distribution_builds_the_same_wheel(of_all_processes: Path, tmp_path: Path, names: set[str]) -> None:
    with tarfile.open(built_once("sdist", of_all_processes)) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (root,) = (tmp_path / "unpacked").iterdir()
    with zipfile.ZipFile(build(root, "wheel", tmp_path / "again")) as archive:
        assert set(archive.namelist()) == names
    needed = [*below(ROOT / "tests", "*"), *below(ROOT / "tools", "*"), *below(ROOT / "docs", "*.md")]
    assert len(needed) > 100
    there = below(root / "tests", "*") | below(root / "tools", "*") | below(root / "docs", "*.md")
    assert set(needed) == there, "its tests could not run"
    read_by_tests = {"README.md", "CHANGELOG.md", "CITATION.cff", "SECURITY.md", "Dockerfile", ".dockerignore"}
    read_by_tests |= {"pyproject.toml", ".ci", ".github"}
    assert read_by_tests <= {path.name for path in root.iterdir()}


def test_the_wheel_works_outside_of_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    environment = dict(os.environ, PYTHONPATH=str(site), COLUMNS="300")
    environment.pop("PANO_MVS_CACHE", None)

    def call(*arguments: str) -> str:
        command = [sys.executable, "-m", "pano_mvs", *arguments]
        done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    where = "import pano_mvs; print(pano_mvs.__file__)"
    found = subprocess.run(
        [sys.executable, "-c", where], cwd=empty, env=environment, capture_output=True, text=True, check=True
    )
    assert found.stdout.startswith(str(site))
    assert "depth.sweep" in call("plugins")
    call("plugin", "new", "filter", "mine")
    assert (empty / "mine.py").is_file()
    assert "4 run, 0 cached" in call("run", "quickstart", "--until", "images")
