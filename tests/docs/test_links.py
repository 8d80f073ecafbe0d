"""Links between the pages point to headings that exist."""

import re
from pathlib import Path

import pytest

PAGES = sorted(Path("docs").rglob("*.md"))
LINK = re.compile(r"\]\(([^)#\s]*)#([^)\s]+)\)")
HEADING = re.compile(r"^#+\s+(.+?)\s*$", re.MULTILINE)
FENCED = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings and of its explicit ids, as MkDocs forms them."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    explicit = set(re.findall(r"""(?:\{:?\s*#|id=["'])([\w.-]+)""", text))
    slugs = {
        re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in HEADING.findall(text)
    }
    return slugs | explicit


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.as_posix())
def test_links_point_to_headings_that_exist(page: Path) -> None:
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    for target, anchor in LINK.findall(text):
        linked = page if not target else (page.parent / target)
        if "://" in target or not linked.is_file():
            continue  # generated pages and other sites: the strict build of the documentation checks those
        assert anchor in anchors(linked), f"{page} links to {target}#{anchor}"
