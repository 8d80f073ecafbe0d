"""Other programs' packages, which tests install from the registries to open our files with them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def pip_packages(folder: Path, *requirements: str) -> Path:
    """Install packages from PyPI without their dependencies, and return the folder to import them from."""
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--disable-pip-version-check"]
    subprocess.run([*install, "--target", str(folder), *requirements], check=True, timeout=300)
    return folder


def npm_packages(folder: Path, *requirements: str) -> Path:
    """Install packages from npm, and return the folder `node_modules`."""
    install = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder)]
    subprocess.run([*install, *requirements], check=True, timeout=300)
    return folder / "node_modules"
