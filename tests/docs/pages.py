"""The pages of the documentation, as their tests read them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

ROOT = Path(__file__).parents[2]


def text_of(page: str) -> str:
    """Return the text of a page of docs, or of README.md."""
    folder = ROOT if page == "README.md" else ROOT / "docs"
    return (folder / page).read_text(encoding="utf-8")


def block(page: str, mark: str) -> str:
    """Return the fenced block that follows a mark."""
    found = re.search(rf"<!-- {mark} -->\n```\w*\n(.*?)```", text_of(page), re.DOTALL)
    assert found, mark
    return found.group(1)


def copy_plugin(page: str, folder: Path) -> Path:
    """Copy the file that a page shows into a folder."""
    (place,) = re.findall(r"<!-- file: (\S+) -->", text_of(page))
    return Path(shutil.copy(ROOT / place, folder))
