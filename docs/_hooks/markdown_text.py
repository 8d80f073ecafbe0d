"""Markdown from what code says of itself: table cells, tables, docstrings."""

from __future__ import annotations

import html
import inspect
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from pano_mvs.cli.plugins.new import rendered

_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields|Frames|Pixels|Sphere|Range|Borders|Units):?$")
_PLUGIN = re.compile(r"<!-- plugin: (\w+) (\w+) -->\n")
_FILE = re.compile(r"<!-- file: (\S+) -->\n")
_ENTRY = re.compile(r"^(\*{0,2}[\w., ]+?)(?: \(.*?\))?: (.*)$")


def cell(text: str) -> str:
    """Return a text as it may stand in a table's cell."""
    return escaped(" ".join(text.split())).replace("|", "\\|")


def escaped(text: str) -> str:
    """Return prose of the code as Markdown that shows it as it is; what stands in backticks stays code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else _plain(part) for part in parts)


def _plain(text: str) -> str:
    return re.sub(r"([*_\[\]\\])", r"\\\1", html.escape(text, quote=False))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; columns in which no row says anything are left out."""
    filled = [list(row) for row in rows]
    keep = [idx for idx, name in enumerate(head) if any(row[idx] for row in filled)]
    lines = [[head[idx] for idx in keep], ["---"] * len(keep), *([row[idx] for idx in keep] for row in filled)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def docstring(text: str) -> str:
    """Return a docstring as Markdown: paragraphs, and the entries of its sections as lists."""
    blocks: list[str] = []
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        first, _, rest = paragraph.partition("\n")
        if _SECTION.match(first):
            blocks.append(f"**{first.rstrip(':')}**\n\n{_entries(rest)}")
        elif paragraph.startswith(("from ", "import ", ">>> ", "@")):
            blocks.append(f"```python\n{paragraph}\n```")
        elif paragraph:
            blocks.append(escaped(paragraph))
    return "\n\n".join(blocks)


def _entries(text: str) -> str:
    """Return the entries of a section, each a name and what it is; lines that go on are joined."""
    entries: list[str] = []
    for line in inspect.cleandoc(text).splitlines():
        if line.startswith(" ") and entries:
            entries[-1] += f" {line.strip()}"
        else:
            entries.append(line)
    return "\n".join(f"- {_entry(entry)}" for entry in entries)


def _entry(entry: str) -> str:
    found = _ENTRY.match(entry)
    return f"`{found[1]}`: {escaped(found[2])}" if found else escaped(entry)


def with_plugins(markdown: str) -> str:
    """Return a page with code in place of `file: PATH`, and of `plugin: KIND NAME`, which `plugin new` writes."""
    root = Path(__file__).parents[2]
    text = _FILE.sub(lambda found: f"```python\n{(root / found[1]).read_text(encoding='utf-8')}```\n", markdown)
    return _PLUGIN.sub(lambda found: f"```python\n{rendered(found[1], found[2])[0]}```\n", text)
