"""Find the hand-written pages that mention a stage."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

DOCS = Path(__file__).parents[1]
_FENCE = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)
_NOT_GUIDES = ("architecture.md", "benchmarks.md", "comparison.md", "glossary.md")


def pages_about(stage: str) -> str:
    """Return a sentence that names the pages in whose text a stage is named, with links; empty if there is none."""
    links = [f"[{title}](../{place})" for place, title, text in _pages() if f"`{stage}`" in text]
    return f"See also {', '.join(links)}." if links else ""


@cache
def _pages() -> list[tuple[str, str, str]]:
    """Return the place, the title and the text without examples of each page."""
    found = []
    for path in sorted(DOCS.glob("**/*.md")):
        place, text = path.relative_to(DOCS).as_posix(), path.read_text(encoding="utf-8")
        if place not in _NOT_GUIDES:
            found.append((place, text.partition("\n")[0].lstrip("# "), _FENCE.sub("", text)))
    return found
