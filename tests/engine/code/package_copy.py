"""A copy of the package, to be edited and run."""

from __future__ import annotations

import shutil
from pathlib import Path

import pano_mvs


def copied_package(folder: Path) -> Path:
    """Copy the package into a folder, and return its place there."""
    package = folder / "pano_mvs"
    shutil.copytree(Path(pano_mvs.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package
