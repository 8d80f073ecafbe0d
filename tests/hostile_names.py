"""Names of images that a hostile file may state; none of them may name a file."""

from __future__ import annotations

HOSTILE_NAMES = (
    "..",
    "../secret.png",
    "a/../../secret.png",
    "/secret.png",
    "//host/share/secret.png",
    "\\\\host\\share\\secret.png",
    "a\\..\\..\\secret.png",
    "C:secret.png",
    "C:/secret.png",
    "a/nul",
    "con.png",
    "e\x07.png",
    "e\x1b[2J.png",
)

LONG_NAMES = ("x" * 251 + ".png", "ü" * 125 + ".png", f"a/{'x' * 255}/b.png")
"""Names that file systems allow, but not those of results, which are longer."""
