"""What the tests of the bundled plugins share with those of the core."""

import tomllib
from pathlib import Path

from tests.cli.conftest import (
    capture,
    finished,
    finished_once,
    of_all_processes,
    pano_mvs,
    quickstart,
    rendered,
    sample,
    toy,
)
from tests.conftest import mine, pytest_collection_finish


def _is_bundled(project: Path) -> bool:
    return "bundled" in tomllib.loads(project.read_text(encoding="utf-8"))["tool"].get("pano_mvs", {})


# The other plugins have dependencies of their own, and are tested where these are installed.
collect_ignore = [
    str(project.parent)
    for project in sorted(Path(__file__).parent.glob("*/pyproject.toml"))
    if not _is_bundled(project)
]
