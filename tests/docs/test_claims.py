"""Versions, extras and capabilities that the documentation states are those of the package."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from pano_mvs.engine.stages.registry import Registry

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OPENS_PANORAMAS = "4.1"
"""pycolmap 4.1.0 opens a model of EQUIRECTANGULAR cameras; 4.0.3 says that the camera model does not exist."""

VERSION = r"(\d+\.\d+)(?:\.\d+)?"
LIMITS = (rf"{VERSION}\s+or\s+newer", rf"older\s+than\s+{VERSION}", rf"since\s+version\s+{VERSION}")


def limits_of(program: str, text: str) -> list[str]:
    """Return the versions that sentences about a program give as the oldest that works."""
    sentences = re.split(r"(?<=[.;|])\s", text)
    behind = [sentence.partition(program)[2] for sentence in sentences if program in sentence]
    return [version for text in behind for limit in LIMITS for version in re.findall(limit, text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_oldest_versions_are_right(page: Path) -> None:
    """Six pages said that COLMAP 4.2 is needed to open a model that 4.1 opens."""
    text = page.read_text(encoding="utf-8")
    assert set(limits_of("COLMAP", text)) <= {OPENS_PANORAMAS}
    oldest_python = PROJECT["requires-python"].removeprefix(">=")
    assert set(re.findall(rf"Python\s+{LIMITS[0]}", text)) <= {oldest_python}


def test_the_versions_are_found() -> None:
    pages = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
    named = [name for name, text in pages.items() if limits_of("COLMAP", text)]
    assert len(named) >= 5
    assert limits_of("COLMAP", "COLMAP 4.2 or newer opens it.") == ["4.2"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_extras_exist(page: Path) -> None:
    named = re.findall(r"pano-mvs\[([\w,]+)\]", page.read_text(encoding="utf-8"))
    assert {extra for names in named for extra in names.split(",")} <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize(
    ("denied", "stage"),
    [
        (r"fisheye images are not supported", "source.dual_fisheye"),
        (r"photographs are not supported|[Pp]erspective .* not supported", "poses.localise"),
        (r"[Nn]o (neural )?networks? (is|are) included", "masks.operator"),
    ],
)
def test_what_a_stage_does_is_not_denied(denied: str, stage: str) -> None:
    """The faq denied what other pages described."""
    assert stage in Registry.installed().stages
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert not [hit for hit in re.findall(rf"(?<!Single )(?:{denied})", text) if hit], page
