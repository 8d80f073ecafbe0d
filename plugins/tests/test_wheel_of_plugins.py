"""What is built for people to install holds the bundled plugins, and a source distribution can build it again."""

from __future__ import annotations

import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest

from hatch_build import entry_points_of, packages_of
from tests.test_wheel import ROOT, below, built_once

pytestmark = pytest.mark.slow


def test_the_wheel_holds_the_bundled_plugins_and_their_entry_points(of_all_processes: Path) -> None:
    with zipfile.ZipFile(built_once("wheel", of_all_processes)) as archive:
        names = set(archive.namelist())
        (listed,) = (name for name in names if name.endswith("entry_points.txt"))
        parser = ConfigParser(delimiters="=")
        parser.optionxform = str  # type: ignore[assignment, method-assign]  # names keep their capitals
        parser.read_string(archive.read(listed).decode())
    packages = packages_of(ROOT)
    assert len(packages) > 5
    for package, folder in packages.items():
        assert {f"{package}/{name}" for name in below(folder, "*")} == {
            name for name in names if name.startswith(f"{package}/")
        }
    for group, entries in entry_points_of(ROOT).items():
        assert dict(parser[group]) == entries


def test_the_source_distribution_holds_the_plugins(of_all_processes: Path) -> None:
    with tarfile.open(built_once("sdist", of_all_processes)) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"plugins/{name}" for name in below(ROOT / "plugins", "*.py")} <= names
