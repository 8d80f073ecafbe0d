"""Pages that are files of the repository elsewhere, and links to what is in the repository but not in the site."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]

PAGES = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "installable_plugins.md": "plugins/README.md",
    "example_plugin.md": "plugins/pano_mvs_example/README.md",
    "las_plugin.md": "plugins/pano_mvs_las/README.md",
    "torch_plugin.md": "plugins/pano_mvs_torch/README.md",
}
"""Page of the site to the file of the repository that it is."""

_CODE = re.compile(r"`[^`\n]*`")
_LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")
_FENCE = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)


def repository_pages() -> dict[str, str]:
    """Return, by their place in the site, pages whose text is kept elsewhere."""
    return {
        page: with_site_links((ROOT / file).read_text(encoding="utf-8"), page, file) for page, file in PAGES.items()
    }


def with_site_links(text: str, page: str, file: str) -> str:
    """Return a page whose links lead to pages of the site; what is not in the site is named by its path.

    Args:
        text: of the page, in Markdown.
        page: its place in the site.
        file: its place in the repository, from which its links start.
    """
    parts = _FENCE.split(text)
    return "".join(part if part.startswith("```") else _with_links(_bare_pipes(part), page, file) for part in parts)


def _bare_pipes(text: str) -> str:
    """Return a text for mkdocs, which shows the backslash that others want before a pipe in code in a table."""
    return _CODE.sub(lambda found: found[0].replace("\\|", "|"), text)


def _with_links(text: str, page: str, file: str) -> str:
    def replaced(found: re.Match[str]) -> str:
        label, target, anchor = found[1], found[2], found[3] or ""
        if ":" in target:
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(file), target))
        if (place := _place_in_site(path)) is not None:
            return f"[{label}]({posixpath.relpath(place, posixpath.dirname(page) or '.')}{anchor})"
        return f"{label} (`{path}`)" if label.strip("`") != path else f"`{path}`"

    return _LINK.sub(replaced, text)


def _place_in_site(path: str) -> str | None:
    """Return where a file of the repository is in the site."""
    for page, file in PAGES.items():
        if path in (file, posixpath.dirname(file)) and path:
            return page
    return path.removeprefix("docs/") if path.startswith("docs/") else None
