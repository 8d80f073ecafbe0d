"""The badges of the README, from pyproject.toml.

    python docs/_pictures/badges.py

`tests/docs/test_badges.py` compares the files with what this module returns.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "images" / "badges"
_HEIGHT, _CHARACTER, _PADDING = 20, 6.6, 6.0
_BADGE = """\
<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height}" role="img" aria-label="{label}: {value}">
  <title>{label}: {value}</title>
  <clipPath id="r"><rect width="{width:.0f}" height="{height}" rx="3"/></clipPath>
  <g clip-path="url(#r)">
    <rect width="{split:.0f}" height="{height}" fill="#4a5560"/>
    <rect x="{split:.0f}" width="{rest:.0f}" height="{height}" fill="#0f6b74"/>
  </g>
  <g fill="#fff" text-anchor="middle" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">
    <text x="{middle:.1f}" y="14" textLength="{label_length:.0f}">{label}</text>
    <text x="{value_middle:.1f}" y="14" textLength="{value_length:.0f}">{value}</text>
  </g>
</svg>
"""


def badges() -> dict[str, str]:
    """Return the text of each badge by its file name."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = settings["project"]
    versions = [found[1] for text in project["classifiers"] if (found := re.search(r"Python :: (3\.\d+)$", text))]
    minimum = settings["tool"]["coverage"]["report"]["fail_under"]
    return {
        "python.svg": badge("python", f"{versions[0]} – {versions[-1]}"),
        "licence.svg": badge("licence", project["license"]),
        "cpu.svg": badge("runs on", "a CPU"),
        "coverage.svg": badge("coverage", f"≥ {minimum} %"),
    }


def badge(label: str, value: str) -> str:
    """Return an image of a label beside a value, as SVG."""
    label_length, value_length = (_CHARACTER * len(text) for text in (label, value))
    split, rest = label_length + 2 * _PADDING, value_length + 2 * _PADDING
    return _BADGE.format(
        width=split + rest,
        height=_HEIGHT,
        split=split,
        rest=rest,
        middle=split / 2,
        value_middle=split + rest / 2,
        label_length=label_length,
        value_length=value_length,
        label=escape(label),
        value=escape(value),
    )


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in badges().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
