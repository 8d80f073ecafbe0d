"""Links between the pages, and from the files beside them, point to files and headings that exist."""

import re
from pathlib import Path

import pytest

PAGES = sorted([*Path("docs").rglob("*.md"), *Path().glob("*.md"), *Path("plugins").rglob("*.md")])
# Pages that the site makes from the code or from files outside docs.
MADE = (
    "reference/",
    "contributing.md",
    "changelog.md",
    "installable_plugins.md",
    "example_plugin.md",
    "las_plugin.md",
    "torch_plugin.md",
)
LINK = re.compile(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)")
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
def test_links_point_to_files_and_headings_that_exist(page: Path) -> None:
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    for target, anchor in LINK.findall(text):
        linked = page if not target else (page.parent / target)
        if "://" in target or target.startswith("mailto:") or target.removeprefix("../").startswith(MADE):
            continue  # the strict build of the documentation checks generated pages
        assert linked.exists(), f"{page} links to {target}"
        if anchor and linked.suffix == ".md":
            assert anchor in anchors(linked), f"{page} links to {target}#{anchor}"
