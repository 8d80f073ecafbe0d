"""Every page that speaks of something visible shows it, and every picture is there, small and described."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")
MOST_BYTES = 250_000

NOTHING_TO_SEE = {
    "architecture.md": "packages and modules",
    "comparison.md": "a table of programs",
    "experiments.md": "tables of the terminal",
    "faq.md": "questions, answered by links to pages with pictures",
    "glossary.md": "definitions, which link to pages with pictures",
    "installation.md": "commands",
    "plugins.md": "code",
    "running.md": "processes, caches and texts on the terminal",
    "tutorials/settings.md": "tables of the terminal",
    "tutorials/cluster.md": "commands on a cluster",
    "workflows.md": "YAML files",
}
"""Pages without a picture, and what they are about."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_a_page_has_a_picture_or_nothing_to_show(page: Path) -> None:
    """Of 34 pages, 20 had none, among them those about images, learned matches and range maps."""
    found = PICTURE.findall(page.read_text(encoding="utf-8"))
    assert bool(found) != (page.relative_to(DOCS).as_posix() in NOTHING_TO_SEE)
    for text, place in found:
        assert len(text) >= 20, f"{place}: say what the picture shows, for those who cannot see it"
        assert (page.parent / place).is_file(), place


def test_pictures_are_small_and_each_is_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in [*PAGES, *ROOT.glob("*.md")])
    for path in sorted((DOCS / "images").glob("*.[jp][pn]g")):
        assert path.stat().st_size < MOST_BYTES, path.name
        assert f"images/{path.name})" in text, path.name
