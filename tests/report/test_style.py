"""Whoever sees little reads the page too: contrast in both themes."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

STYLE = (files("pano_mvs.report") / "templates" / "report.css").read_text(encoding="utf-8")
LEAST = 4.5  # WCAG 2.2, 1.4.3, level AA


def themes() -> dict[str, dict[str, str]]:
    light, dark = re.findall(r":root \{(.*?)\}", STYLE, re.DOTALL)[:2]
    colors = dict(re.findall(r"--([\w-]+):(#[0-9a-f]{3,6})", light))
    return {"light": colors, "dark": colors | dict(re.findall(r"--([\w-]+):(#[0-9a-f]{3,6})", dark))}


def luminance(color: str) -> float:
    digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
    parts = [int(digits[at : at + 2], 16) / 255 for at in (0, 2, 4)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize(
    ("text", "ground"),
    [
        ("ink", "paper"),
        ("ink", "ground"),
        ("soft", "paper"),
        ("soft", "ground"),
        ("accent", "ground"),
        ("good", "good-bg"),
        ("fair", "fair-bg"),
        ("bad", "bad-bg"),
        ("fair", "paper"),
        ("bad", "paper"),
        ("ink", "bad-bg"),
        ("soft", "bad-bg"),
    ],
)
def test_text_stands_out_from_its_ground(theme: str, text: str, ground: str) -> None:
    first, second = sorted((luminance(themes()[theme][name]) for name in (text, ground)), reverse=True)
    assert (first + 0.05) / (second + 0.05) >= LEAST
